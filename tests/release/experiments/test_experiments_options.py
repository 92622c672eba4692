"""`python -m experiments bench options`: one option at a time, beside what its row names."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from experiments._cli import app
from experiments.bench import options_scenes

POINTS = 512


@pytest.mark.slow  # over a hundred programs
def test_every_option_gets_a_row(tmp_path):
    result = CliRunner().invoke(
        app, ["bench", "options", "--points", str(POINTS), "--rounds", "2", "--backend", "warp", "--out", str(tmp_path)]
    )
    assert result.exit_code == 0, result.output
    table = pd.read_csv(tmp_path / "cpu_warp.csv")
    assert list(table["option"]) == [option.name for option in options_scenes.options()]
    of: Any = table.set_index("option")
    assert set(of.index[of["status"] != "ok"]) <= {"sum, a table indexed by species"}
    sums = of.index.str.startswith("sum, ")
    assert (of.loc[~sums, ["list_s", "count_s", "beside_list_s", "beside_count_s", "list_ratio", "count_ratio"]] > 0).all(axis=None)
    assert set(of.index[of["sum_s"].isna()]) - {"sum, a table indexed by species"} == {"half", "skin of a tenth"}

    entries, plain = of["entries"], of["entries"]["open, whole list"]
    assert 2 * entries["half"] == plain == entries["a cutoff per particle, equal"]
    assert entries["include_self"] == plain + POINTS
    assert entries["box, periodic"] > entries["box, periodic along x"] > plain
    smooth = of.index.str.startswith("57 neighbors each") & ~of.index.str.contains("far")
    assert (entries[smooth] == 57 * POINTS).all()
    many = of[of["beside"] == options_scenes.AS_MANY]
    np.testing.assert_allclose(many["beside_entries"], many["entries"], rtol=0.02)

    assert (of["scipy_differs"].dropna() == 0).sum() == 16, "SciPy decides in float64, and no tie is left to rounding"
    assert of["hashgrid_behind"].notna().sum() == 16
    assert of["hashgrid_differs"]["two cutoffs, ties, spacing 0.0001"] > 0, "in single precision some are"


@pytest.mark.parametrize("spacing", [1.0, 0.25])
def test_ties_are_in_the_scene_of_ties(spacing):
    asked = options_scenes._lattice(spacing)(343)
    x, r = np.asarray(asked.x, float), np.asarray(asked.cutoff, float)
    distances = np.linalg.norm(x[:, None] - x, axis=-1)
    inner = ((x > 2.5 * spacing) & (x < 3.5 * spacing)).all(axis=1)
    assert (distances[inner] == r[inner, None]).sum() == (6 if r[inner] == 2 * spacing else 30)
