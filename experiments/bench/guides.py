"""What a reader of a guide waits for: its code in a fresh process, with and without compiled kernels, and what is compiled."""

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Annotated

import jax
import typer

from experiments import _machine
from experiments.bench import start, table

GUIDES = start.ROOT / "docs" / "guides"
COLUMNS = ("platform", "guide", "cache", "page_s", "programs", "compile_s", "kernels", "process_s", "status", "reason")
COLUMNS += ("others_cores", "device", "jax", "warp", "commit", "dirty")
_FOUR = {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"}  # what the guide to many devices tells its readers to set


def command(out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform.")] = Path("out") / "guides") -> str:
    """Time the code of each guide in fresh processes, and count the programs and kernels that it compiles.

    `page_s` is the time of a page's blocks from `import jfrnn` on, after `import jax`; `compile_s` of it compilation. The folder
    of kernels is empty ("cold"), or holds what another process compiled ("warm"); `kernels` are those in it afterwards.
    """
    parts = [(page.stem, partial(_rows, page)) for page in sorted(GUIDES.glob("*.md"))]
    frame = table.measure(out, f"guides_{jax.default_backend()}", parts, _machine.commit(start.ROOT), COLUMNS)
    return table.text(frame, COLUMNS[1:10])


def _rows(page: Path) -> Iterator[table.Line]:
    more = _FOUR if page.stem == "many-devices" else {}
    yield from ({"guide": page.stem} | row for row in start.run_twice(str(page), start.ROOT, more))
