"""Which report a folder of rows gets, by what its first row says."""

import json
from pathlib import Path

import typer

from experiments import _report
from experiments._rows import RowFile


def report(folder: Path) -> None:
    """Print the tables of a folder, and write them and pictures beside the rows."""
    columns = _columns(folder / "rows.jsonl")
    if {"figures", "curves"} <= columns:
        from experiments.sph import validate

        typer.echo(validate.report(RowFile(folder, validate.CaseRow).read(), folder))
    elif {"particle_steps_per_s", "way"} <= columns:
        from experiments.sph import speed, speed_report

        typer.echo(speed_report.report(RowFile(folder, speed.StepRow).read(), folder))
    elif {"compensated", "way"} <= columns:
        from experiments.bench import sums, sums_report

        typer.echo(sums_report.report(RowFile(folder, sums.SumRow).read(), folder))
    elif {"scaling", "halo"} <= columns:
        from experiments.bench import distributed

        typer.echo(distributed.report(RowFile(folder, distributed.DeviceRow).read(), folder))
    elif "kind" in columns:
        from experiments.gpu import report as gpu_report

        typer.echo(gpu_report.report(folder))
    else:
        _report.report(folder)


def _columns(path: Path) -> set[str]:
    """Return what the first row has; nothing where it is no row."""
    try:
        with path.open(encoding="utf-8") as stream:
            row = json.loads(stream.readline())
    except (OSError, ValueError):
        return set()
    return set(row) if isinstance(row, dict) else set()
