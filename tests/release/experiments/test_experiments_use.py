"""`python -m experiments bench use`: what lists cost those who use them."""

import pandas as pd
import pytest

from experiments.bench import use


def test_every_order_gets_a_row():
    table = pd.DataFrame(use._order_rows(300, 2)).set_index("order")
    assert list(table.index) == ["random", "row", "morton", "hilbert"]
    assert table.loc["random", "gain"] == 1
    assert (table[["search_ms", "sum_ms", "gain"]] > 0).all(axis=None)
    assert (table.loc[["row", "morton", "hilbert"], "sort_ms"] > 0).all()


@pytest.mark.parametrize("clump", [0, 40])
def test_both_sums_agree_and_a_clump_makes_a_row_longer(monkeypatch, clump):
    monkeypatch.setattr(use, "CLUMPS", (clump,))
    (row,) = use._padding_rows(300, 2)  # compares the sums itself
    assert row["longest"] >= max(clump - 1, row["mean"])
    assert row["compressed_MB"] == pytest.approx(8e-6 * row["mean"] * (300 + clump))
    assert min(row["padded_ms"], row["compressed_ms"], row["make_ms"]) > 0
