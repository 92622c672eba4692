"""The commands of the fluid solver."""

from pathlib import Path
from typing import Annotated

import typer

from experiments._commands import RetryFailed, RowsFolder, check_choice, check_names, finite, take_folder
from experiments._errors import UsageError


def run(
    scene: Annotated[str, typer.Argument(help="Fluid scene, such as dam, taylor-green, dam-break-2d, jet: see `list`.")],
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="key=value: of the scene, or of its physics; `list SCENE` names them.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the run; out/sph/SCENE without it.")] = None,
    initial: Annotated[Path | None, typer.Option(help="Initial particles instead of the scene's: .npz or .csv.")] = None,
    solid: Annotated[Path | None, typer.Option(help="A closed wall instead of the scene's, in 3D: STL, OBJ or PLY.")] = None,
    solid_unit: Annotated[
        float | None, typer.Option(min=1e-9, max=1e3, callback=finite, help="Unit of that file [m]: 0.001 for mm; 1 without.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, max=1_000_000, help="Snapshots after the first.")] = 50,
    dtype: Annotated[str, typer.Option(help="float32 or float64.")] = "float64",
    neighbors: Annotated[str, typer.Option(help="pair_sum; list: a list with a skin; auto: what is faster here.")] = "auto",
    skin: Annotated[float, typer.Option(min=0.01, max=100, callback=finite, help="Of the list, in particle spacings.")] = 0.3,
    pictures: Annotated[bool, typer.Option(help="Draw frames and a GIF.")] = True,
) -> str:
    """Run a fluid scene, or go on with it from its last snapshot: snapshots, energies, pictures."""
    check_choice("--dtype", dtype, ("float32", "float64"))
    check_choice("--neighbors", neighbors, ("auto", "pair_sum", "list"))
    if solid is None and solid_unit is not None:
        raise UsageError(f"--solid-unit {solid_unit:g}: is the unit of the file of --solid; name that file too")
    import jax

    jax.config.update("jax_enable_x64", dtype == "float64")
    from experiments.sph import run as sph_run
    from experiments.sph import settings as sph_settings

    fluid = sph_settings.make_scene(scene, settings or [])
    fluid = fluid if initial is None else sph_settings.with_particles(fluid, initial)
    fluid = fluid if solid is None else sph_settings.with_solid(fluid, solid, 1.0 if solid_unit is None else solid_unit)
    folder = out or Path("out") / "sph" / scene
    sph_run.run(fluid, folder, sph_run.How(frames, dtype, neighbors, skin, pictures))
    return str(folder)


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
