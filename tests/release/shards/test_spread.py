"""Arrays that are spread over several devices, given to the library as they are; what is checked stands in `spread_checks.py`."""

import pytest
from places import TESTS
from test_distributed import names_in, outcomes

CHECKS = TESTS / "spread_checks.py"
SLOW = {"more_on_automatic_axes", "more_on_explicit_axes", "more_in_shard_map"}
QUICK = [name for name in names_in(CHECKS) if name not in SLOW]


@pytest.fixture(scope="module")
def quick():
    """All quick checks in one process: most of their time is its start and what they compile alike."""
    return outcomes(QUICK, CHECKS)


@pytest.mark.parametrize("name", QUICK)
def test_on_four_devices(quick, name):
    assert quick[name] is None, quick[name]


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(SLOW))
def test_more_on_four_devices(name):
    wrong = outcomes([name], CHECKS)[name]
    assert wrong is None, wrong
