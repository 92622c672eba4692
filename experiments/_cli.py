"""The command line: sweeps, scenes, questions of one table each; the solver's commands are in `experiments._cli_sph`."""

from pathlib import Path
from typing import Annotated

import typer

from experiments import _cli_sph, _commands
from experiments._commands import (
    MOST_POINTS,
    Dim,
    Fill,
    Layout,
    RetryFailed,
    RowsFolder,
    Seed,
    Spacing,
    finite,
    positive,
    stoppable,
    take_file,
    take_folder,
    usage_errors,
)
from experiments._errors import UsageError

SWEEPS, SCENES, QUESTIONS, DEVICES = "sweeps", "scenes", "questions", "devices"
ENGINES = ("auto", "jax", "warp", "brute")
WALLS = ("warp", "bvh", "jax")
app = typer.Typer(cls=_commands.Commands, no_args_is_help=True, add_completion=False, rich_markup_mode=None)

Rounds = Annotated[int, typer.Option(min=2, max=100_000, help="Timed runs of each.")]


@app.command(rich_help_panel=SWEEPS, short_help="Run a sweep, or go on with it.")
def run(
    config: Annotated[Path, typer.Argument(help="Sweep config, TOML.")],
    out: RowsFolder = None,
    retry_failed: RetryFailed = False,
    processes: Annotated[int | None, typer.Option(min=1, max=10_000, help="Of each row, instead of the config's.")] = None,
    most_seconds: Annotated[
        float | None, typer.Option(callback=positive, help="That repeats of a row may take [s], instead of the config's.")
    ] = None,
    shard: Annotated[str, typer.Option(help="K/N: every N-th scene from the K-th on, in OUT/shard-K-of-N.")] = "1/1",
) -> None:
    """Run a sweep, or go on with it: rows that are there are not measured again, unless less time cut their repeats short."""
    with usage_errors():
        from experiments import _config, _sweep

        part, parts = _read_shard(shard)
        given = _config.load(config)
        asked = {"processes": processes, "most_seconds": most_seconds}
        given = given.model_copy(update={name: value for name, value in asked.items() if value is not None})
        folder = out or Path("out") / config.stem
        folder = take_folder(folder if parts == 1 else folder / f"shard-{part}-of-{parts}")
        with stoppable():
            rows = _sweep.run(given, config.stem, folder, retry_failed, (part, parts))
        typer.echo(f"{_sweep.count_results(rows)}; rows in {folder / 'rows.jsonl'}")


def _read_shard(text: str) -> tuple[int, int]:
    """Return (k, n) of "k/n"."""
    part, _, parts = text.partition("/")
    if not (part.isdecimal() and parts.isdecimal() and 1 <= int(part) <= int(parts)):
        raise UsageError(f"--shard {text}: expected K/N with 1 <= K <= N, such as 2/8")
    return int(part), int(parts)


@app.command(rich_help_panel=SWEEPS, short_help="Print the table of a sweep, draw its pictures.")
def report(folder: Annotated[Path, typer.Argument(help="Folder of a sweep.")]) -> None:
    """Print a short table of a sweep; write the whole one, beside the thesis's, and draw its pictures."""
    with usage_errors():
        from experiments import _report

        _report.report(folder)


@app.command(rich_help_panel=SWEEPS, short_help="Put rows of shards, or of machines, together.")
def merge(
    out: Annotated[Path, typer.Argument(help="Folder that takes the rows.")],
    parts: Annotated[list[Path] | None, typer.Argument(help="Folders with rows; all OUT/shard-* without.")] = None,
) -> None:
    """Put the rows of shards, or of other machines, into one folder; a row that is there already is not added."""
    with usage_errors():
        from experiments import _sweep

        came = _sweep.merge(take_folder(out, "OUT"), parts or sorted(out.glob("shard-*")))
        typer.echo(f"{came} rows came; all are in {out / 'rows.jsonl'}")


@app.command(rich_help_panel=SWEEPS, short_help="Measure one sum over neighbors in many ways.")
def sums(
    config: Annotated[Path, typer.Argument(help="Config of sums, TOML.")] = Path("experiments/configs/sums.toml"),
    out: RowsFolder = None,
    retry_failed: RetryFailed = False,
) -> None:
    """Measure one sum over neighbors in many ways, or go on with it; then print a table, and draw pictures beside the rows."""
    with usage_errors():
        from experiments import _config, _sums, _sums_report

        given, folder = _config.load(config, _sums.Config), take_folder(out or Path("out") / config.stem)
        with stoppable():
            rows = _sums.run(given, folder, retry_failed)
        typer.echo(_sums_report.report(rows, folder))


@app.command(name="list", rich_help_panel=SCENES, short_help="Say what there is, and what a scene can be told.")
def list_names(
    scene: Annotated[str | None, typer.Argument(help="Fluid scene whose settings are asked for; all names without.")] = None,
) -> None:
    """Print the names of fluid scenes, layouts, methods and configs; or the settings of a fluid scene, with units and ranges."""
    with usage_errors():
        from experiments import _list

        typer.echo(_list.names() if scene is None else _list.scene(scene))


@app.command(rich_help_panel=SCENES, short_help="Draw a layout.")
def show(
    layout: Layout,
    fill: Fill = None,
    spacing: Spacing = 1e-4,
    dim: Dim = 3,
    seed: Seed = 0,
    out: Annotated[Path | None, typer.Option(help="Picture; out/LAYOUT.png without it.")] = None,
) -> None:
    """Draw a layout."""
    with usage_errors():
        from experiments import _layouts, _show

        scene = _layouts.make(layout, spacing=spacing, dim=dim, seed=seed, fill=fill)
        path = out or Path("out") / f"{layout}.png"
        _show.check(path)
        typer.echo(_show.draw(scene, take_file(path)))


@app.command(rich_help_panel=SCENES, short_help="Write the points of a layout to a file.")
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
    with usage_errors():
        from experiments import _export, _layouts

        _export.check(out)
        scene = _layouts.make(layout, spacing=spacing, dim=dim, seed=seed, fill=fill, dtype=dtype)
        typer.echo(_export.write(scene, take_file(out), counts))


_cli_sph.add_to(app)


@app.command(rich_help_panel=QUESTIONS, short_help="Time what empty space costs.")
def domain(
    separations: Annotated[
        list[float] | None, typer.Argument(callback=positive, help="Distances of the blobs [cutoffs]; 10 to 1e6 without.")
    ] = None,
    points: Annotated[int, typer.Option(min=2, max=10_000, help="Particles in both blobs together.")] = 1000,
) -> None:
    """Time a search of two blobs ever further apart: what empty space costs."""
    with usage_errors():
        from experiments import _domain

        table = _domain.domain_table(separations or [10.0, 1e2, 1e3, 1e4, 1e5, 1e6], points)
        typer.echo(table.to_string(index=False, float_format="%.3g"))


@app.command(rich_help_panel=QUESTIONS, short_help="Time a list that is kept while particles move.")
def skin(
    spacing: Spacing = 1e-4,
    steps: Annotated[int, typer.Option(min=1, max=1_000_000, help="Steps of a compiled scan.")] = 100,
    repeats: Annotated[int, typer.Option(min=2, max=100_000, help="Timed scans.")] = 3,
) -> None:
    """Time a step that keeps its neighbor list beside one that makes it anew."""
    with usage_errors():
        from experiments import _skin

        typer.echo(_skin.skin_table(spacing, steps, repeats).to_string(index=False, float_format="%.3g"))


@app.command(rich_help_panel=QUESTIONS, short_help="Time each option of a search.")
def options(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform and backend.")] = Path("out") / "options",
    points: Annotated[int, typer.Option(min=100, max=MOST_POINTS, help="Random points.")] = 100_000,
    rounds: Rounds = 15,
    backend: Annotated[str, typer.Option(help="As in jfrnn.search: auto, warp, jax or brute.")] = "warp",
) -> None:
    """Time each option of a search beside a plain one."""
    with usage_errors():
        _commands.check_choice("--backend", backend, ENGINES)
        import jax

        jax.config.update("jax_enable_x64", True)
        from experiments import _options

        path = _options.measure(take_folder(out), points, rounds, backend)
        typer.echo(_options.table(path))
        typer.echo(path)


@app.command(rich_help_panel=QUESTIONS, short_help="Time lattices full of exact ties.")
def ties(
    scenes: Annotated[Path, typer.Argument(help="Config of a sweep whose layouts are measured, TOML.")] = Path(
        "experiments/configs/thesis.toml"
    ),
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform and backend.")] = Path("out") / "ties",
    rounds: Rounds = 15,
    backend: Annotated[str, typer.Option(help="As in jfrnn.search: auto, warp, jax or brute.")] = "warp",
    cube: Annotated[
        int | None, typer.Option(min=1000, max=MOST_POINTS, help="Sites of a cube to measure instead of these layouts.")
    ] = None,
) -> None:
    """Time lattices full of pairs at exactly the cutoff beside the same scenes moved at random."""
    with usage_errors():
        _commands.check_choice("--backend", backend, ENGINES)
        import jax

        jax.config.update("jax_enable_x64", True)
        from experiments import _config, _ties

        _config.load(scenes)  # what is wrong with it is said before a folder is made
        path = _ties.measure(take_folder(out), rounds, backend, scenes, cube)
        typer.echo(_ties.table(path))
        typer.echo(path)


@app.command(rich_help_panel=QUESTIONS, short_help="Time what uses a list.")
def use(
    points: Annotated[int, typer.Option(min=100, max=MOST_POINTS, help="Random points.")] = 250_000,
    rounds: Rounds = 9,
) -> None:
    """Time what uses a list: particles in random order or sorted, rows padded or compressed."""
    with usage_errors():
        from experiments import _use

        for table in (_use.order_table(points, rounds), _use.rows_table(points // 5, rounds)):
            typer.echo(table.to_string(index=False, float_format="%.3g") + "\n")


@app.command(rich_help_panel=QUESTIONS, short_help="Time the backends over sizes.")
def crossover(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform.")] = Path("out") / "crossovers",
    repeats: Annotated[int, typer.Option(min=20, max=100_000, help="Timed runs of each backend.")] = 30,
) -> None:
    """Time the backends side by side over sizes and neighbors: what `backend="auto"` goes by."""
    with usage_errors():
        from experiments import _crossover

        typer.echo(_crossover.measure(take_folder(out), repeats=repeats))


_FACES = [500, 12_000, 200_000]
_CUTOFFS = [0.01, 0.03, 0.1, 0.3, 0.8]


@app.command(rich_help_panel=QUESTIONS, short_help="Time the triangles that are near particles.")
def triangles(
    out: Annotated[Path, typer.Option(help="Folder of the table, one file per platform and backend.")] = Path("out") / "triangles",
    points: Annotated[int, typer.Option(min=100, max=MOST_POINTS, help="Random points in the box of a gear.")] = 250_000,
    faces: Annotated[list[int], typer.Option(min=100, max=10_000_000, help="Of gears, about; may be said several times.")] = _FACES,
    cutoff: Annotated[list[float], typer.Option(callback=positive, help="[modules]; may be said several times.")] = _CUTOFFS,
    rounds: Rounds = 9,
    backend: Annotated[str, typer.Option(help="warp (beside bvh), bvh or jax.")] = "warp",
) -> None:
    """Time the triangles of a gear that are near particles, beside trimesh and libigl where they are installed."""
    with usage_errors():
        _commands.check_choice("--backend", backend, WALLS)
        from experiments import _triangles

        path = _triangles.measure(take_folder(out), points, tuple(faces), rounds, backend, tuple(cutoff))
        typer.echo(_triangles.table(path))


@app.command(rich_help_panel=QUESTIONS, short_help="Ask other libraries for the hard cases.")
def peers(
    names: Annotated[list[str] | None, typer.Argument(help="Of libraries; all that are known without.")] = None,
    out: Annotated[Path, typer.Option(help="Folder of the table.")] = Path("out") / "peers",
    limit: Annotated[float, typer.Option(min=1, max=1e6, callback=finite, help="Time for one answer [s].")] = 60.0,
) -> None:
    """Ask other libraries for the hard cases, and print a table of their answers (pip install -e '.[peers]')."""
    with usage_errors():
        from experiments import _peers

        unknown = [name for name in names or [] if name not in _peers.PEERS]
        if unknown:
            raise UsageError(f"no peer {unknown[0]!r}: {', '.join(_peers.PEERS)}")
        path = _peers.measure(take_folder(out), names or list(_peers.PEERS), limit)
        typer.echo(_peers.table(path))
        typer.echo(path)


@app.command(rich_help_panel=DEVICES, short_help="Decide the hard cases on a GPU, take timings.")
def gpu(
    config: Annotated[Path, typer.Argument(help="GPU config, TOML.")],
    out: Annotated[Path, typer.Option(help="Folder of the rows.")],
) -> None:
    """Decide every hard case on the GPU, then take all timings; rows are added to OUT/rows.jsonl one by one."""
    with usage_errors():
        from experiments import _gpu

        wrong = _gpu.run(_gpu.load(config), take_folder(out))
        typer.echo(f"{wrong} wrong; rows in {out / 'rows.jsonl'}; python -m experiments gpu-report {out} makes a table of them")
        if wrong:
            raise typer.Exit(1)


@app.command(rich_help_panel=DEVICES, short_help="Print the tables of a GPU run.")
def gpu_report(folder: Annotated[Path, typer.Argument(help="Folder of a GPU run.")]) -> None:
    """Print the tables of a GPU run, and write them and a picture against the floor beside the rows."""
    with usage_errors():
        from experiments import _gpu_report

        typer.echo(_gpu_report.report(folder))


@app.command(name="distributed", rich_help_panel=DEVICES, short_help="Time lists, sums and fluids on 1 to k devices.")
def over_devices(
    config: Annotated[Path, typer.Argument(help="Config of scaling over devices, TOML.")],
    out: RowsFolder = None,
    retry_failed: Annotated[bool, typer.Option("--retry-failed", help="Measure failed rows again.")] = False,
) -> None:
    """Time lists, sums and steps of a fluid on 1 to k devices, or go on with it; then print a table."""
    with usage_errors():
        from experiments import _config, _distributed

        given, folder = _config.load(config, _distributed.Config), take_folder(out or Path("out") / config.stem)
        _distributed.prepare(given)
        with stoppable():
            rows = _distributed.run(given, folder, retry_failed)
        typer.echo(_distributed.report(rows, folder))
