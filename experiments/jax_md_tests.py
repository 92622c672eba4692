"""Run jax-md's own tests with `jfrnn.jax_md` in the place of its neighbor lists, and beside that with its own.

`python -m experiments.jax_md_tests CHECKOUT [FILE ...]`: CHECKOUT is a clone of https://github.com/jax-md/jax-md, whose package is
used, and FILE are tests in it (default: partition, energy, smap and simulate). It prints how many tests pass, and which do so with
one list alone. As a plugin of pytest (`-p experiments.jax_md_tests`), this file puts our functions in place.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

FILES = ("partition_test.py", "energy_test.py", "smap_test.py", "simulate_test.py")
_OURS = "JFRNN_IN_JAX_MD"
ROOT = Path(__file__).resolve().parents[1]


def put_in_place() -> None:
    """Replace the functions of jax-md that make neighbor lists, also where they are defaults of arguments."""
    from jax_md import custom_partition, energy, partition  # pyright: ignore[reportMissingImports]

    import jfrnn.jax_md as ours

    for module, name in ((partition, "neighbor_list"), (custom_partition, "neighbor_list_multi_image")):
        theirs, new = getattr(module, name), getattr(ours, name)
        setattr(module, name, new)
        for function in vars(energy).values():
            defaults = getattr(function, "__defaults__", None)
            if isinstance(defaults, tuple) and any(x is theirs for x in defaults):
                function.__defaults__ = tuple(new if x is theirs else x for x in defaults)


def run(checkout: Path, files: list[str], ours: bool, options: list[str]) -> dict[str, str]:
    """Return the outcome of each test, by name."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(checkout), str(ROOT), os.environ.get("PYTHONPATH", "")])}
    environment |= {_OURS: "1"} if ours else {}
    command = [sys.executable, "-m", "pytest", "-q", "-rA", "--no-header", "-p", "experiments.jax_md_tests", "-c", os.devnull]
    command += ["--rootdir", str(checkout), *options, *(str(checkout / "tests" / file) for file in files)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment, cwd=checkout)
    found = re.findall(r"^(PASSED|FAILED|ERROR) \S*?(\w+\.py\S*)", done.stdout, re.MULTILINE)
    if not found:
        raise SystemExit(f"no test ran: {(done.stdout + done.stderr).strip()[-2000:]}")
    return {name: outcome for outcome, name in found}


def main(words: list[str]) -> None:
    """Print the table, and what passes with one list alone."""
    options = [word for word in words if word.startswith("-")]
    names = [word for word in words if not word.startswith("-")]
    if not names or not (Path(names[0]) / "tests").is_dir():
        raise SystemExit(__doc__)
    checkout, files = Path(names[0]).resolve(), names[1:] or list(FILES)
    for file in files:
        theirs, ours = (run(checkout, [file], which, options) for which in (False, True))
        passed = [{name for name, outcome in found.items() if outcome == "PASSED"} for found in (theirs, ours)]
        count = len(theirs.keys() | ours.keys())
        print(f"{file}: of {count} tests pass {len(passed[1])} with jfrnn, {len(passed[0])} with its own list", flush=True)
        for who, only in (("its own list", passed[0] - passed[1]), ("jfrnn", passed[1] - passed[0])):
            for name in sorted(only):
                print(f"  only with {who}: {name}")


if __name__ == "__main__":
    main(sys.argv[1:])
elif os.environ.get(_OURS):
    put_in_place()
