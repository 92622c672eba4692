"""The command line."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from experiments._errors import UsageError

app = typer.Typer(help="Compare neighbor searches, and look at the scenes.", no_args_is_help=True, add_completion=False)

Layout = Annotated[str, typer.Argument(help="Name of a layout, such as full, clusters2, corners.")]
Fill = Annotated[float | None, typer.Option(help="Share of the full domain, above 0 and up to 1.")]
Spacing = Annotated[float, typer.Option(help="Distance of lattice neighbors [m].")]
Dim = Annotated[int, typer.Option(min=2, max=3, help="Dimensions.")]
Seed = Annotated[int, typer.Option(min=0, help="Seed of random layouts.")]


@contextmanager
def _usage_errors() -> Iterator[None]:
    """Turn a UsageError, or a file that cannot be read or written, into a message and exit code 2."""
    try:
        yield
    except (UsageError, OSError) as error:
        typer.echo(f"error: {error}", err=True)
        raise typer.Exit(2) from error


@contextmanager
def _stoppable(start: str = "here") -> Iterator[None]:
    """Where the user stops what keeps its rows, say where the same command goes on, and exit with code 130."""
    try:
        yield
    except KeyboardInterrupt:
        typer.echo(f"stopped; the same command goes on from {start}", err=True)
        raise typer.Exit(130) from None


@app.command()
def run(
    config: Annotated[Path, typer.Argument(help="Sweep config, TOML.")],
    out: Annotated[Path | None, typer.Option(help="Folder of the rows; out/NAME without it.")] = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Measure missing, failed and timed-out rows again.")] = False,
    processes: Annotated[int | None, typer.Option(min=1, help="Of each row, instead of the config's.")] = None,
    most_seconds: Annotated[float | None, typer.Option(help="That repeats of a row may take, instead of the config's.")] = None,
    shard: Annotated[str, typer.Option(help="K/N: every N-th scene from the K-th on, in OUT/shard-K-of-N.")] = "1/1",
) -> None:
    """Run a sweep, or go on with it: rows that are there are not measured again, unless less time cut their repeats short."""
    with _usage_errors():
        from experiments import _config, _sweep

        part, parts = _read_shard(shard)
        folder = out or Path("out") / config.stem
        folder = folder if parts == 1 else folder / f"shard-{part}-of-{parts}"
        given = _config.load(config)
        if most_seconds is not None and not most_seconds > 0:
            raise UsageError(f"--most-seconds {most_seconds}: expected more than 0")
        asked = {"processes": processes, "most_seconds": most_seconds}
        given = given.model_copy(update={name: value for name, value in asked.items() if value is not None})
        with _stoppable():
            rows = _sweep.run(given, config.stem, folder, retry_failed, (part, parts))
        typer.echo(f"{_sweep.count_results(rows)}; rows in {folder / 'rows.jsonl'}")


def _read_shard(text: str) -> tuple[int, int]:
    """Return (k, n) of "k/n"."""
    part, _, parts = text.partition("/")
    if not (part.isdecimal() and parts.isdecimal() and 1 <= int(part) <= int(parts)):
        raise UsageError(f"--shard {text}: expected K/N with 1 <= K <= N, such as 2/8")
    return int(part), int(parts)


@app.command()
def merge(
    out: Annotated[Path, typer.Argument(help="Folder that takes the rows.")],
    parts: Annotated[list[Path] | None, typer.Argument(help="Folders with rows; all OUT/shard-* without.")] = None,
) -> None:
    """Put the rows of shards, or of other machines, into one folder; a row that is there already is not added."""
    with _usage_errors():
        from experiments import _sweep

        came = _sweep.merge(out, parts or sorted(out.glob("shard-*")))
        typer.echo(f"{came} rows came; all are in {out / 'rows.jsonl'}")


@app.command()
def gpu(
    config: Annotated[Path, typer.Argument(help="GPU config, TOML.")],
    out: Annotated[Path, typer.Option(help="Folder of the rows.")],
) -> None:
    """Decide every hard case on the GPU, then take all timings; rows are added to OUT/rows.jsonl one by one."""
    with _usage_errors():
        from experiments import _gpu

        wrong = _gpu.run(_gpu.load(config), out)
        typer.echo(f"{wrong} wrong; rows in {out / 'rows.jsonl'}; python -m experiments gpu-report {out} makes a table of them")
        if wrong:
            raise typer.Exit(1)


@app.command()
def gpu_report(folder: Annotated[Path, typer.Argument(help="Folder of a GPU run.")]) -> None:
    """Print the tables of a GPU run, and write them and a picture against the floor beside the rows."""
    with _usage_errors():
        from experiments import _gpu_report

        typer.echo(_gpu_report.report(folder))


@app.command()
def report(folder: Annotated[Path, typer.Argument(help="Folder of a sweep.")]) -> None:
    """Print the table of a sweep beside the thesis's, and draw its pictures."""
    with _usage_errors():
        from experiments import _report

        _report.report(folder)


@app.command()
def domain(
    separations: Annotated[list[float] | None, typer.Argument(help="Distances of the blobs [cutoffs]; 10 to 1e6 without.")] = None,
    points: Annotated[int, typer.Option(min=2, help="Particles in both blobs together.")] = 1000,
) -> None:
    """Time a search of two blobs ever further apart: what empty space costs."""
    with _usage_errors():
        from experiments import _domain

        table = _domain.domain_table(separations or [10.0, 1e2, 1e3, 1e4, 1e5, 1e6], points)
        typer.echo(table.to_string(index=False, float_format="%.3g"))


@app.command()
def skin(
    spacing: Spacing = 1e-4,
    steps: Annotated[int, typer.Option(min=1, help="Steps of a compiled scan.")] = 100,
    repeats: Annotated[int, typer.Option(min=2, help="Timed scans.")] = 3,
) -> None:
    """Time a step that keeps its neighbor list beside one that makes it anew."""
    with _usage_errors():
        from experiments import _skin

        typer.echo(_skin.skin_table(spacing, steps, repeats).to_string(index=False, float_format="%.3g"))


@app.command()
def crossover(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform.")] = Path("out") / "crossovers",
    repeats: Annotated[int, typer.Option(min=20, help="Timed runs of each backend.")] = 30,
) -> None:
    """Time the backends side by side over sizes and neighbors: what `backend="auto"` goes by."""
    with _usage_errors():
        from experiments import _crossover

        typer.echo(_crossover.measure(out, repeats=repeats))


@app.command()
def options(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform and backend.")] = Path("out") / "options",
    points: Annotated[int, typer.Option(min=100, help="Random points.")] = 100_000,
    rounds: Annotated[int, typer.Option(min=2, help="Timed runs of each option.")] = 15,
    backend: Annotated[str, typer.Option(help="As in jfrnn.search.")] = "warp",
) -> None:
    """Time each option of a search beside a plain one."""
    with _usage_errors():
        import jax

        jax.config.update("jax_enable_x64", True)
        from experiments import _options

        path = _options.measure(out, points, rounds, backend)
        typer.echo(_options.table(path))
        typer.echo(path)


@app.command()
def ties(
    scenes: Annotated[Path, typer.Argument(help="Config of a sweep whose layouts are measured, TOML.")] = Path(
        "experiments/configs/thesis.toml"
    ),
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform and backend.")] = Path("out") / "ties",
    rounds: Annotated[int, typer.Option(min=2, help="Timed runs of each.")] = 15,
    backend: Annotated[str, typer.Option(help="As in jfrnn.search.")] = "warp",
    cube: Annotated[int | None, typer.Option(min=1000, help="Sites of a cube to measure instead of these layouts.")] = None,
) -> None:
    """Time lattices full of pairs at exactly the cutoff beside the same scenes moved at random."""
    with _usage_errors():
        import jax

        jax.config.update("jax_enable_x64", True)
        from experiments import _ties

        path = _ties.measure(out, rounds, backend, scenes, cube)
        typer.echo(_ties.table(path))
        typer.echo(path)


@app.command()
def use(
    points: Annotated[int, typer.Option(min=100, help="Random points.")] = 250_000,
    rounds: Annotated[int, typer.Option(min=2, help="Timed runs of each.")] = 9,
) -> None:
    """Time what uses a list: particles in random order or sorted, rows padded or compressed."""
    with _usage_errors():
        from experiments import _use

        for table in (_use.order_table(points, rounds), _use.rows_table(points // 5, rounds)):
            typer.echo(table.to_string(index=False, float_format="%.3g") + "\n")


@app.command()
def sums(
    config: Annotated[Path, typer.Argument(help="Config of sums, TOML.")] = Path("experiments/configs/sums.toml"),
    out: Annotated[Path | None, typer.Option(help="Folder of the rows; out/NAME without it.")] = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Measure missing, failed and timed-out rows again.")] = False,
) -> None:
    """Measure one sum over neighbors in many ways, or go on with it; then print a table, and draw pictures beside the rows."""
    with _usage_errors():
        from experiments import _config, _sums, _sums_report

        folder = out or Path("out") / config.stem
        with _stoppable():
            rows = _sums.run(_config.load(config, _sums.Config), folder, retry_failed)
        typer.echo(_sums_report.report(rows, folder))


@app.command(name="distributed")
def over_devices(
    config: Annotated[Path, typer.Argument(help="Config of scaling over devices, TOML.")],
    out: Annotated[Path | None, typer.Option(help="Folder of the rows; out/NAME without it.")] = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Measure failed rows again.")] = False,
) -> None:
    """Time lists, sums and steps of a fluid on 1 to k devices, or go on with it; then print a table."""
    with _usage_errors():
        from experiments import _config, _distributed

        given, folder = _config.load(config, _distributed.Config), out or Path("out") / config.stem
        _distributed.prepare(given)
        with _stoppable():
            rows = _distributed.run(given, folder, retry_failed)
        typer.echo(_distributed.report(rows, folder))


@app.command()
def sph(
    scene: Annotated[str, typer.Argument(help="Fluid scene, such as dam, taylor-green, dam-break-2d, jet.")],
    settings: Annotated[list[str] | None, typer.Option("--set", help="key=value: of the scene, or of its physics.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the run; out/sph/SCENE without it.")] = None,
    initial: Annotated[Path | None, typer.Option(help="Initial particles instead of the scene's: .npz or .csv.")] = None,
    frames: Annotated[int, typer.Option(min=1, help="Snapshots after the first.")] = 50,
    dtype: Annotated[str, typer.Option(help="float32 or float64.")] = "float64",
    neighbors: Annotated[str, typer.Option(help="pair_sum, or list: a list with a skin.")] = "pair_sum",
    skin: Annotated[float, typer.Option(min=0.01, help="Of the list, in particle spacings.")] = 0.3,
    pictures: Annotated[bool, typer.Option(help="Draw frames and a GIF.")] = True,
) -> None:
    """Run a fluid scene, or go on with it from its last snapshot: snapshots, energies, pictures."""
    with _usage_errors():
        import jax

        jax.config.update("jax_enable_x64", dtype == "float64")
        from experiments.sph import run as sph_run
        from experiments.sph import settings as sph_settings

        for name, value, allowed in (("dtype", dtype, ("float32", "float64")), ("neighbors", neighbors, ("pair_sum", "list"))):
            if value not in allowed:
                raise UsageError(f"--{name} {value}: allowed: {', '.join(allowed)}")
        fluid = sph_settings.make_scene(scene, settings or [])
        fluid = fluid if initial is None else sph_settings.with_particles(fluid, initial)
        folder = out or Path("out") / "sph" / scene
        with _stoppable("the last snapshot"):
            sph_run.run(fluid, folder, sph_run.How(frames, dtype, neighbors, skin, pictures))
        typer.echo(folder)


@app.command()
def sph_validate(
    cases: Annotated[list[str] | None, typer.Argument(help="Such as taylor-green, cavity; all, long ones last, without.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of the rows.")] = Path("out") / "sph-validate",
) -> None:
    """Run fluid scenes with known answers, or go on with them; then print a table, and draw pictures beside the rows."""
    with _usage_errors():
        import jax

        jax.config.update("jax_enable_x64", True)
        from experiments.sph import validate

        with _stoppable():
            rows = validate.run(cases or [], out)
        typer.echo(validate.report(rows, out))


@app.command()
def sph_speed(
    config: Annotated[Path, typer.Argument(help="Config of steps, TOML.")] = Path("experiments/configs/sph_speed.toml"),
    out: Annotated[Path | None, typer.Option(help="Folder of the rows; out/NAME without it.")] = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Measure missing and failed rows again.")] = False,
) -> None:
    """Time steps of a fluid scene by ways to find its pairs, or go on with it; then print a table, and draw pictures."""
    with _usage_errors():
        import jax

        from experiments import _config
        from experiments.sph import speed, speed_report

        given, folder = _config.load(config, speed.Config), out or Path("out") / config.stem
        jax.config.update("jax_enable_x64", given.dtype == "float64")
        with _stoppable():
            rows = speed.run(given, folder, retry_failed)
        typer.echo(speed_report.report(rows, folder))


@app.command()
def sph_gradients(
    names: Annotated[list[str] | None, typer.Argument(help="viscosity, jet, droplet, memory; all without.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of tables and pictures.")] = Path("out") / "sph-gradients",
    evaluations: Annotated[int, typer.Option(min=1, help="Runs to solve a problem with, at most.")] = 25,
) -> None:
    """Solve inverse problems by gradients through whole runs of a fluid, and measure the memory that such gradients take."""
    with _usage_errors():
        import jax

        jax.config.update("jax_enable_x64", True)
        from experiments.sph import gradients

        typer.echo(gradients.run(names or [], out, evaluations))


@app.command()
def peers(
    names: Annotated[list[str] | None, typer.Argument(help="Of libraries; all that are known without.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of the table.")] = Path("out") / "peers",
    limit: Annotated[float, typer.Option(min=1, help="Time for one answer [s].")] = 60.0,
) -> None:
    """Ask other libraries for the hard cases, and print a table of their answers (pip install -e '.[peers]')."""
    with _usage_errors():
        from experiments import _peers

        unknown = [name for name in names or [] if name not in _peers.PEERS]
        if unknown:
            raise UsageError(f"no peer {unknown[0]!r}: {', '.join(_peers.PEERS)}")
        path = _peers.measure(out, names or list(_peers.PEERS), limit)
        typer.echo(_peers.table(path))
        typer.echo(path)


@app.command()
def show(
    layout: Layout,
    fill: Fill = None,
    spacing: Spacing = 1e-4,
    dim: Dim = 3,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option(help="Picture; out/LAYOUT.png without it.")] = None,
) -> None:
    """Draw a layout."""
    with _usage_errors():
        from experiments import _layouts, _show

        scene = _layouts.make(layout, spacing=spacing, dim=dim, seed=seed, fill=fill)
        typer.echo(_show.draw(scene, out or Path("out") / f"{layout}.png"))


_FACES = [500, 12_000, 200_000]
_CUTOFFS = [0.01, 0.03, 0.1, 0.3, 0.8]


@app.command()
def triangles(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform and backend.")] = Path("out") / "triangles",
    points: Annotated[int, typer.Option(min=100, help="Random points in the box of a gear.")] = 250_000,
    faces: Annotated[list[int], typer.Option(min=100, help="Of gears, about; may be said several times.")] = _FACES,
    cutoff: Annotated[list[float], typer.Option(help="[modules]; may be said several times.")] = _CUTOFFS,
    rounds: Annotated[int, typer.Option(min=2, help="Timed runs of each way.")] = 9,
    backend: Annotated[str, typer.Option(help="warp (beside bvh), bvh or jax.")] = "warp",
) -> None:
    """Time the triangles of a gear that are near particles, beside trimesh and libigl where they are installed."""
    with _usage_errors():
        from experiments import _triangles

        typer.echo(_triangles.table(_triangles.measure(out, points, tuple(faces), rounds, backend, tuple(cutoff))))


@app.command()
def export(
    layout: Layout,
    out: Annotated[Path, typer.Option(help="File: .csv, .vtp or .vtk.")],
    fill: Fill = None,
    spacing: Spacing = 1e-4,
    dim: Dim = 3,
    seed: Seed = 0,
    dtype: Annotated[str, typer.Option(help="float32 or float64.")] = "float32",
    counts: Annotated[bool, typer.Option("--counts", help="Store the number of neighbors of each point too.")] = False,
) -> None:
    """Write the points of a layout to a file, for ParaView or a spreadsheet."""
    with _usage_errors():
        from experiments import _export, _layouts

        _export.check(out)
        scene = _layouts.make(layout, spacing=spacing, dim=dim, seed=seed, fill=fill, dtype=dtype)
        typer.echo(_export.write(scene, out, counts))
