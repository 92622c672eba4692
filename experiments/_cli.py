"""The command line: sweeps, scenes, and groups of commands that are imported when they are asked for."""

import textwrap
from pathlib import Path
from typing import Annotated

import typer

from experiments import _commands
from experiments._commands import take_file, take_folder
from experiments._errors import UsageError

_GPU = {"gpu": ("experiments.bench.gpu", "Decide the hard cases on this device, take timings.")}
app = typer.Typer(cls=_commands.those_of(_GPU), no_args_is_help=True, add_completion=False, rich_markup_mode=None)


@app.command(short_help="Run a sweep, or go on with it.")
def run(
    config: Annotated[Path, typer.Argument(help="Sweep config, TOML.")],
    out: _commands.RowsFolder = None,
    retry_failed: _commands.RetryFailed = False,
    processes: Annotated[int | None, typer.Option(min=1, max=10_000, help="Of each row, instead of the config's.")] = None,
    most_seconds: Annotated[
        float | None, typer.Option(callback=_commands.positive, help="That repeats of a row may take [s], instead of the config's.")
    ] = None,
    method_names: Annotated[str | None, typer.Option("--methods", help="A,B,C: instead of the config's.")] = None,
    layouts: Annotated[str | None, typer.Option(help="A,B,C: instead of the config's, with its fills.")] = None,
    fills: Annotated[str | None, typer.Option(help="0.02,0.1: of all layouts, instead of the config's.")] = None,
    shard: Annotated[str, typer.Option(help="K/N: every N-th scene from the K-th on, in OUT/shard-K-of-N.")] = "1/1",
) -> None:
    """Run a sweep, or go on with it: rows that are there are not measured again, unless less time cut their repeats short.

    Ends with status 1 where no row has a result.
    """
    from experiments import _config, _sweep

    part, parts = _read_shard(shard)
    asked = {"methods": _split(method_names), "layouts": _split(layouts), "fills": _split(fills)}
    given = _config.narrow(_config.load(config), **asked, processes=processes, most_seconds=most_seconds)
    folder = out or Path("out") / config.stem
    folder = take_folder(folder if parts == 1 else folder / f"shard-{part}-of-{parts}")
    with _commands.stoppable():
        rows = _sweep.run(given, config.stem, folder, retry_failed, (part, parts))
    typer.echo(f"{_sweep.count_results(rows)}; rows in {folder / 'rows.jsonl'}")
    if rows and not any(row.status == "ok" for row in rows):
        raise typer.Exit(1)


def _split(text: str | None) -> list[str] | None:
    """Return the words between commas; None where there are none."""
    return [word.strip() for word in text.split(",")] if text else None


@app.command(short_help="Write a config to begin a sweep of your own with.")
def init(path: Annotated[Path, typer.Argument(help="TOML file.")] = Path("sweep.toml")) -> None:
    """Write a config of a small sweep, with every key, its default and what it means."""
    from experiments.pages import configs

    if path.exists():
        raise UsageError(f"{path}: there is such a file already; name another")
    take_file(path, "PATH").write_text(configs.example(), encoding="utf-8")
    typer.echo(f"{path}; run it: python -m experiments run {path}")


def _read_shard(text: str) -> tuple[int, int]:
    """Return (k, n) of "k/n"."""
    part, _, parts = text.partition("/")
    if not (part.isdecimal() and parts.isdecimal() and 1 <= int(part) <= int(parts)):
        raise UsageError(f"--shard {text}: expected K/N with 1 <= K <= N, such as 2/8")
    return int(part), int(parts)


@app.command(short_help="Print the tables of a folder of rows, draw pictures.")
def report(folder: Annotated[Path, typer.Argument(help="Folder with rows.jsonl.")]) -> None:
    """Print the table of what was measured, and write it and pictures beside the rows: of a sweep, beside the thesis's figures."""
    from experiments import _report

    _report.report(folder)


@app.command(short_help="Make the tables of README.md and docs/ anew.")
def tables() -> None:
    """Make the tables of README.md and docs/ anew from the rows under experiments/results, and print the pages that changed."""
    from experiments import pages

    typer.echo("\n".join(str(path.relative_to(pages.ROOT)) for path in pages.write()) or "nothing changed")


@app.command(short_help="Put rows of shards, or of machines, together.")
def merge(
    out: Annotated[Path, typer.Argument(help="Folder that takes the rows.")],
    parts: Annotated[list[Path] | None, typer.Argument(help="Folders with rows; all OUT/shard-* without.")] = None,
) -> None:
    """Put the rows of shards, or of other machines, into one folder; a row that is there already is not added."""
    from experiments import _sweep

    came = _sweep.merge(take_folder(out, "OUT"), parts or sorted(out.glob("shard-*")))
    typer.echo(f"{came} rows came; all are in {out / 'rows.jsonl'}")


@app.command(name="list", short_help="Say what layouts, methods and configs there are.")
def list_names() -> None:
    """Print the names of layouts, methods and configs; `python -m jfrnn.sph list` prints those of fluid scenes."""
    from experiments import _layouts, methods

    absent = [name for name in methods.names() if methods.lacks(name)]
    parts = {
        "Layouts (show, export, configs; N is any number of tiles)": _layouts.names(),
        "Methods (configs of run)": [name for name in methods.names() if name not in absent],
        "Methods that are not installed": absent,
        "Configs (experiments/configs)": sorted(path.stem for path in (Path(__file__).parent / "configs").glob("*.toml")),
    }
    wrap = textwrap.TextWrapper(80, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False)
    typer.echo("\n\n".join(f"{title}:\n{wrap.fill(', '.join(known))}" for title, known in parts.items() if known))


@app.command(short_help="Draw a layout.")
def show(
    layout: _commands.Layout,
    fill: _commands.Fill = None,
    spacing: _commands.Spacing = 1e-4,
    dim: _commands.Dim = 3,
    seed: _commands.Seed = 0,
    out: Annotated[Path | None, typer.Option(help="Picture; out/LAYOUT.png without it.")] = None,
) -> None:
    """Draw a layout."""
    from experiments import _layouts, _show

    scene = _layouts.make(layout, spacing=spacing, dim=dim, seed=seed, fill=fill)
    path = out or Path("out") / f"{layout}.png"
    _commands.check_ending(path, _show.endings())
    typer.echo(_show.draw(scene, take_file(path)))


@app.command(short_help="Write the points of a layout to a file.")
def export(
    layout: _commands.Layout,
    out: Annotated[Path, typer.Option(help="File: .csv, .vtp or .vtk.")],
    fill: _commands.Fill = None,
    spacing: _commands.Spacing = 1e-4,
    dim: _commands.Dim = 3,
    seed: _commands.Seed = 0,
    dtype: Annotated[str, typer.Option(help="float32 or float64.")] = "float32",
    counts: Annotated[bool, typer.Option("--counts", help="Store the number of neighbors of each point too.")] = False,
) -> None:
    """Write the points of a layout to a file, for ParaView or a spreadsheet."""
    from experiments import _export, _layouts

    _commands.check_ending(out, _export.ENDINGS)
    scene = _layouts.make(layout, spacing=spacing, dim=dim, seed=seed, fill=fill, dtype=dtype)
    typer.echo(_export.write(scene, take_file(out), counts))


def _add_group(name: str, text: str, module: str, there: dict[str, str]) -> None:
    """Add a group of commands, each the function `command` of the module of its name."""
    kind = _commands.those_of({each: (f"{module}.{each}", short) for each, short in there.items()})
    app.add_typer(typer.Typer(cls=kind, no_args_is_help=True, rich_markup_mode=None), name=name, short_help=text)


_add_group(
    *("bench", "Answer a question with a table: bench NAME.", "experiments.bench"),
    {
        "crystals": "Time batches of crystals in cells of their own.",
        "distributed": "Time lists, sums and fluids on 1 to k devices.",
        "arrays": "Time the array engine beside jax-md.",
        "latency": "Time calls for few particles.",
        "lj": "Time a Lennard-Jones liquid, beside jax-md, OpenMM and LAMMPS.",
        "options": "Time each option of a search.",
        "peers": "Ask other libraries for the hard cases.",
        "start": "Time a fresh process up to its first result.",
        "guides": "Time the code of each guide, and count what it compiles.",
        "structures": "Time structures of atoms, one after another.",
        "sums": "Measure one sum over neighbors in many ways.",
        "ties": "Time lattices full of exact ties.",
        "triangles": "Time the triangles that are near particles.",
    },
)
_add_group(
    *("sph", "Validate, time and differentiate the fluid solver.", "experiments.sph"),
    {
        "validate": "Run fluid scenes with known answers.",
        "speed": "Time steps of a fluid scene.",
        "gradients": "Solve inverse problems by gradients.",
        "peers": "Time steps of solvers that others released.",
    },
)
