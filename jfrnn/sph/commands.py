"""The command line: `python -m jfrnn.sph run SCENE`, and `list`, which says what scenes there are and what each can be told."""

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import jax

from jfrnn.sph import files, listing, ranges, runs, settings, toml_scenes
from jfrnn.sph.errors import DivergedError, SceneError
from jfrnn.sph.relaxing import relax


class _Parser(argparse.ArgumentParser):
    """Says mistakes in one line."""

    def error(self, message: str) -> NoReturn:
        """Raise what `main` says in a line."""
        raise SceneError(f"{message.removeprefix('argument ')} (see {self.prog} --help)")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a command; return its exit code: 0, 1 where nobody reads what it says, 2 after a mistake, 130 where it was stopped."""
    try:
        given = _make_parser().parse_args(arguments)
        print(given.act(given), flush=True)
    except (SceneError, DivergedError) as error:
        return _refuse(str(error))
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or Python writes what is left, and complains, at its end
        return 1
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _refuse(f"{where}{error.strerror or error}")
    except MemoryError as error:
        return _refuse(f"this takes more memory than there is; ask for fewer particles: {error}")
    except KeyboardInterrupt:
        print("stopped; the same command goes on from here", file=sys.stderr)
        return 130
    return 0


def _refuse(message: str) -> int:
    print(f"error: {message}", file=sys.stderr)
    return 2


def _make_parser() -> _Parser:
    parser = _Parser(prog="python -m jfrnn.sph", description="A fluid solver on jfrnn.", allow_abbrev=False)
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    add: Callable[..., _Parser] = commands.add_parser
    what = "run a scene, or go on with it from its last snapshot: snapshots, energies, pictures"
    run = add("run", help=what, description=what, allow_abbrev=False)
    run.set_defaults(act=_run)
    run.add_argument("scene", metavar="SCENE", help="such as dam, taylor-green, jet: see `list`; or an own one, FILE.toml")
    told = "of the scene, or of its physics; `list SCENE` names them"
    run.add_argument("--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", help=told)
    run.add_argument("--out", type=Path, help="folder of the run; out/sph/SCENE without it")
    run.add_argument("--initial", type=Path, metavar="FILE", help="initial particles instead of the scene's: .npz or .csv")
    run.add_argument("--solid", type=Path, metavar="FILE", help="a closed wall instead of the scene's, in 3D: STL, OBJ or PLY")
    relax = "begin with particles that a constant pressure has spread evenly, instead of a lattice"
    run.add_argument("--relax", action="store_true", help=relax)
    unit = "unit of that file [m]: 0.001 for mm; 1 without"
    run.add_argument("--solid-unit", type=_number(float, ge=1e-9, le=1e3), metavar="M", help=unit)
    run.add_argument("--frames", type=_number(int, **ranges.MANY), metavar="N", help="snapshots after the first: 50")
    run.add_argument("--dtype", type=_word("float32", "float64"), default="float64", help="float32 or float64")
    ways = "pair_sum; list: a list with a skin; auto: what is faster here"
    run.add_argument("--neighbors", type=_word("auto", "pair_sum", "list"), default="auto", help=ways)
    skin = "of the list, in particle spacings"
    run.add_argument("--skin", type=_number(float, **ranges.SKIN), default=0.3, metavar="SPACINGS", help=skin)
    pictures = "whether frames and a GIF are drawn"
    run.add_argument("--pictures", action=argparse.BooleanOptionalAction, default=None, help=pictures)
    hdf = "whether all snapshots also go into one file, SCENE.vtkhdf"
    run.add_argument("--hdf", action=argparse.BooleanOptionalAction, default=None, help=hdf)
    what = "say what scenes there are, or what a scene can be told, with units and ranges"
    names = add("list", help=what, description=what, allow_abbrev=False)
    names.set_defaults(act=lambda given: listing.names() if given.scene is None else listing.scene(given.scene))
    names.add_argument("scene", metavar="SCENE", nargs="?", help="scene whose settings are asked for; all names without")
    return parser


def _number(kind: type, **bounds: float) -> Callable[[str], Any]:
    """Return what reads a number within bounds."""

    def read(text: str) -> Any:  # noqa: ANN401
        try:
            return ranges.read(kind, text, bounds)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"got {text!r}; {error}") from error

    return read


def _word(*allowed: str) -> Callable[[str], str]:
    """Return what reads one of some words."""

    def read(text: str) -> str:
        if text not in allowed:
            raise argparse.ArgumentTypeError(f"got {text!r}; allowed: {', '.join(allowed)}")
        return text

    return read


def _run(given: argparse.Namespace) -> str:
    if given.solid is None and given.solid_unit is not None:
        raise SceneError(f"--solid-unit {given.solid_unit:g}: is the unit of the file of --solid; name that file too")
    jax.config.update("jax_enable_x64", given.dtype == "float64")
    how = runs.How(dtype=given.dtype, neighbors=given.neighbors, skin=given.skin)
    if given.scene.endswith(".toml"):
        if given.settings:
            raise SceneError(f"--set {given.settings[0]}: {given.scene} says all of its scene; change it there")
        scene, output = toml_scenes.read_file(given.scene)
        how = replace(how, **output)
    else:
        scene = settings.make_scene(given.scene, given.settings)
    scene = scene if given.initial is None else files.with_particles(scene, given.initial)
    scene = relax(scene) if given.relax else scene
    scene = scene if given.solid is None else files.with_solid(scene, given.solid, given.solid_unit or 1.0)
    folder = given.out or Path("out") / "sph" / scene.name
    told = {name: getattr(given, name) for name in ("frames", "pictures", "hdf") if getattr(given, name) is not None}
    runs.run(scene, folder, replace(how, **told))
    return str(folder)
