"""`python -m experiments bench options`: one option at a time, beside what its row names; scenes against distances of all pairs."""

from typing import Any

import numpy as np
import pandas as pd
import pytest
from commanded import told

from experiments.bench import options, options_scenes

POINTS = 512
CHOSEN = {  # and the columns that their rows lack
    "open, whole list": (),
    "half": ("sum",),
    "list with reverse slots": ("count", "sum", "peers"),
    "flat list of edges": ("count", "sum", "peers"),
    "excluded pairs": ("peers",),
    "sum, the largest term": ("list", "count", "peers"),
    "a cutoff per particle within a factor of 2, either": ("peers",),
    "a cutoff per pair of two species": ("peers",),
    "57 neighbors each, uniform, ten far away": (),
    "two cutoffs, ties, spacing 0.0001": (),
}


def all_of() -> dict[str, options_scenes.Option]:
    """Return all options by name."""
    return {option.name: option for option in options_scenes.options()}


def neighbors(asked: options_scenes.Asked) -> np.ndarray:
    """Count the particles within the cutoffs of each, in float64."""
    x, cutoffs = (np.asarray(a, np.float64) for a in (asked.x, asked.cutoff))
    return (np.linalg.norm(x[:, None] - x, axis=-1) < cutoffs.reshape(-1, 1)).sum(axis=1) - 1


@pytest.mark.slow  # forty programs
def test_options_get_rows(tmp_path, monkeypatch):
    every = all_of()
    monkeypatch.setattr(options, "options", lambda: [every[name] for name in CHOSEN])
    told("bench", "options", "--points", POINTS, "--rounds", 2, "--backend", "warp", "--out", tmp_path)
    of: Any = pd.read_csv(tmp_path / "cpu_warp.csv").set_index("option")
    assert list(of.index) == list(CHOSEN)
    assert (of["status"] == "ok").all(), of["reason"]
    for name, lacks in CHOSEN.items():
        for what in ("list", "count", "sum"):
            assert of.loc[name, [f"{what}_s", f"beside_{what}_s", f"{what}_ratio"]].isna().all() == (what in lacks), (name, what)
        if name != "half":
            assert of.loc[name, ["scipy_behind", "hashgrid_behind"]].isna().all() == ("peers" in lacks), name
    entries, plain = of["entries"], of["entries"]["open, whole list"]
    assert plain == neighbors(every["open, whole list"].make(POINTS)).sum() == 2 * entries["half"]
    assert (of["beside_entries"][of["beside"] == options_scenes.FIRST] == plain).all()
    assert (of["scipy_differs"].dropna() == 0).all(), "SciPy decides in float64"
    assert of["hashgrid_differs"]["two cutoffs, ties, spacing 0.0001"] > 0, "in single precision some ties are pairs"


@pytest.mark.parametrize("name", [name for name, option in all_of().items() if "57" in name and "far" not in name])
def test_smoothing_lengths_and_one_cutoff_with_as_many_pairs(name):
    option = all_of()[name]
    asked = option.make(POINTS)
    assert (neighbors(asked) == 57).all()
    np.testing.assert_allclose(neighbors(options_scenes.beside(option, asked, 57 * POINTS)).mean(), 57, rtol=0.01)


@pytest.mark.parametrize("factor", options_scenes.FACTORS)
def test_spreads_make_as_many_pairs(factor):
    asked = all_of()[f"cutoffs over a factor of {factor}, uniform points"].make(POINTS)
    volumes = np.asarray(asked.cutoff, np.float64) ** 3 * 4 / 3 * np.pi
    assert asked.spread == factor
    np.testing.assert_allclose(volumes.mean() * POINTS, options_scenes.NEIGHBORS, rtol=1e-5)


def test_ties_are_in_the_scene_of_ties():
    asked = all_of()["two cutoffs, ties, spacing 1"].make(343)
    x, r = np.asarray(asked.x, np.float64), np.asarray(asked.cutoff)
    at_cutoff = (np.linalg.norm(x[:, None] - x, axis=-1) == r[:, None]).sum(axis=1)
    assert at_cutoff[(x == 3).all(axis=1)] == (6 if r[(x == 3).all(axis=1)] == 2 else 30)
