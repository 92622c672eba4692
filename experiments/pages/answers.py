"""The table of what the thesis left open: ratios of times over rounds, with the intervals that hold them."""

from functools import cache
from typing import Any

from experiments import _study
from experiments._study import Effect
from experiments.pages.rows import markdown, number


@cache
def _rounds(sweep: str) -> Any:  # noqa: ANN401
    """Return the rounds of a sweep, a line per process."""
    return _study.rounds(_study.rows(sweep))


def _line(question: str, what: str, one: Effect | None, memory: Effect | None = None) -> list[str]:
    assert one is not None, what
    interval = f"{number(one.low, digits=3)} to {number(one.high, digits=3)}"
    return [question, what, number(one.ratio, digits=3), interval, "" if memory is None else number(memory.ratio, digits=3)]


def answers() -> str:
    """Return a line for each comparison."""
    thesis, turns, cubes, motion, order, domain = map(
        _rounds, ("thesis_cpu", "sweep_orientation", "sweep_cluster_size", "sweep_motion", "sweep_order", "sweep_domain")
    )
    lines = []
    for method, title in (("nanoflann-cpp", "nanoflann in C++"), ("scipy-kdtree", "SciPy's tree"), ("ann-kd", "ANN's kd-tree")):
        lines.append(_line("1", f"{title} / cell lists", _study.effect(thesis, "method", "cll", method)))
    turned = turns[turns.layout.str.startswith("turned")]
    turned = turned.assign(angle=turned.angle.gt(0).map({True: "turned", False: "straight"}))
    for method, title in (("cll", "cell lists"), ("scipy-kdtree", "SciPy's tree"), ("ann-kd-nolist", "ANN's tree")):
        found = _study.effect(turned[turned.method == method], "angle", "straight", "turned")
        lines.append(_line("2", f"{title}: cubes turned / straight", found))
    smaller = cubes[(cubes.method == "cll") & cubes.layout.str.startswith("turned")]
    for layout, sites in (("turned4", 6), ("turned6", 4)):
        found = _study.effect(smaller, "layout", "turned2", layout)
        lines.append(_line("3", f"cell lists: cubes of {sites} / 12 sites", found))
    lists = (("ann-kd", "ann-kd-nolist", "ANN: list / no list"), ("warp", "pair-sum", "jfrnn: list / density by `pair_sum`"))
    for listed, direct, title in lists:
        both = [_study.effect(thesis, "method", direct, listed, value) for value in ("median_s", "search_mb")]
        lines.append(_line("4", title, *both))
    steps = (("warp-update", "warp-rebuild", "jfrnn: list with a skin / anew"),)
    steps += (("nanoflann-dynamic", "nanoflann-rebuild", "nanoflann: dynamic / new tree"),)
    for kept, anew, title in steps:
        for far in (0.001, 0.3):
            found = _study.effect(motion[motion.motion == far], "method", anew, kept)
            lines.append(_line("5", f"{title}, {far} spacings per step", found))
    for method, title in (("warp", "jfrnn, list"), ("scipy-kdtree", "SciPy's tree")):
        found = _study.effect(domain[domain.method == method], "growth", 1.0, 1e6)
        lines.append(_line("domain", f"{title}: a million times the domain / as it is", found))
    shuffled = (("cll", "cell lists"), ("ann-kd-nolist", "ANN's tree"), ("scipy-kdtree", "SciPy's tree"), ("warp", "jfrnn, list"))
    for method, title in shuffled:
        found = _study.effect(order[order.method == method], "order", "layout", "shuffled")
        lines.append(_line("order", f"{title}: shuffled / in order", found))
    return markdown(("question", "what / against what", ">ratio of times", ">95 %", ">of memory"), lines)


TABLES = {"thesis-answers": answers}
