"""The commands that measure and validate the fluid solver."""

from pathlib import Path
from typing import Annotated

import typer

from experiments._commands import RetryFailed, RowsFolder, check_names, take_folder


def validate(
    cases: Annotated[list[str] | None, typer.Argument(help="Such as taylor-green, cavity; all, long ones last, without.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of the rows.")] = Path("out") / "sph-validate",
) -> str:
    """Run fluid scenes with known answers, or go on with them; then print a table, and draw pictures beside the rows."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from experiments.sph import validate

    check_names("case", cases, validate.CASES)
    return validate.report(validate.run(cases or [], take_folder(out)), out)


def speed(
    config: Annotated[Path, typer.Argument(help="Config of steps, TOML.")] = Path("experiments/configs/sph_speed.toml"),
    out: RowsFolder = None,
    retry_failed: RetryFailed = False,
) -> str:
    """Time steps of a fluid scene by ways to find its pairs, or go on with it; then print a table, and draw pictures."""
    import jax

    from experiments import _config
    from experiments.sph import speed, speed_report

    given, folder = _config.load(config, speed.Config), take_folder(out or Path("out") / config.stem)
    jax.config.update("jax_enable_x64", given.dtype == "float64")
    return speed_report.report(speed.run(given, folder, retry_failed), folder)


def gradients(
    names: Annotated[list[str] | None, typer.Argument(help="viscosity, jet, droplet, memory; all without.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of tables and pictures.")] = Path("out") / "sph-gradients",
    evaluations: Annotated[int, typer.Option(min=1, max=100_000, help="Runs to solve a problem with, at most.")] = 25,
) -> str:
    """Solve inverse problems by gradients through whole runs of a fluid, and measure the memory that such gradients take."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from experiments.sph import gradients

    check_names("problem", names, gradients.NAMES)
    return gradients.run(names or [], take_folder(out), evaluations)


def start(
    resolutions: Annotated[list[int] | None, typer.Argument(min=8, help="Particles along each axis; 25 and 50 without.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of the table.")] = Path("out") / "sph-start",
) -> str:
    """Run decaying vortices from a lattice, from displaced and from relaxed particles, or go on with it; then print a table."""
    import jax

    jax.config.update("jax_enable_x64", True)
    from experiments.sph import start

    return start.run(tuple(resolutions or (25, 50)), take_folder(out))


def peers(out: Annotated[Path, typer.Option(help="Folder of the table.")] = Path("out") / "sph-peers") -> str:
    """Time steps of solvers that others released and that are installed here, or go on with it; then print a table."""
    from experiments.sph import peers

    return peers.run(take_folder(out))


def thin(
    sizes: Annotated[list[int] | None, typer.Argument(min=4, help="Particles along a block; 16 and 32 without.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of the table.")] = Path("out") / "sph-thin",
) -> str:
    """Time steps beside a thin wall, with lines of sight and without; then print a table."""
    from experiments.sph import thin

    return thin.run(tuple(sizes or (16, 32)), take_folder(out))
