"""The command of `sph peers`."""

from pathlib import Path
from typing import Annotated

import typer

from experiments._commands import take_folder
from experiments.sph import peers as solvers


def peers(out: Annotated[Path, typer.Option(help="Folder of the table.")] = Path("out") / "sph-peers") -> str:
    """Time steps of solvers that others released and that are installed here, or go on with it; then print a table."""
    return solvers.run(take_folder(out))
