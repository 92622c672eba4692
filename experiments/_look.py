"""How pictures look: the library in blue, each other method in a color of its own, markers, names beside marks, a headline."""

from collections import Counter
from collections.abc import Iterable, Sequence
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from matplotlib.transforms import Bbox, blended_transform_factory

OURS, PEER, FAINT = "#0072B2", "0.4", "0.85"
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "0.6")
"""What is no method, but an angle, a layout or a stage: colors of M. Okabe and K. Ito, distinct to color-blind eyes too."""
PEERS_COLORS = ("#C44E00", "#00805C", "#B0578D", "#8F6500", "#6A51A3", "#8C4A3C", "#4F7F1C", "0.4")
"""Of other methods of a picture, in order: as text they can be read on white."""
MARKERS = "osD^vPXp<"
MOST = 8  # methods in a picture
WIDTH = 7.0  # of a picture that is to be read when it is 700 pixels wide [inches]
NAMES = {  # of our methods, those that lead first
    **{"warp": "jfrnn, list", "pair-sum": "jfrnn, pair_sum", "jax": "jfrnn, engine jax", "warp-update": "jfrnn, kept list"},
    **{"warp-rebuild": "jfrnn, list anew", "warp-counts": "jfrnn, counts", "hashgrid": "jfrnn, engine hashgrid"},
    **{"brute": "jfrnn, brute"},
}
PEERS = {  # of others, those first that people know best
    **{"cll": "cell lists (thesis)", "vesin": "vesin", "scipy-kdtree": "SciPy's cKDTree", "nvalchemi": "nvalchemi"},
    **{"nanoflann-cpp": "nanoflann, C++", "ann-kd": "ANN, kd-tree", "matscipy-neighbours": "matscipy-neighbours"},
    **{"hashgrid-plain": "Warp's HashGrid", "nanoflann-dynamic": "nanoflann, dynamic", "nanoflann-rebuild": "nanoflann, anew"},
}
THIN = "\N{THIN SPACE}"
LEADING = ("warp", "warp-update", "hashgrid", "jax", "warp-rebuild", "warp-counts", "pair-sum", "brute")
"""Which of our methods speaks for us in a headline: the first that is there."""
WITHOUT_LIST = ("pair-sum", "warp-counts", "ann-kd-nolist", "scipy-kdtree-nolist")


def plain(number: float) -> str:
    """Return a number as people write it: a thin space before every three digits, no exponent."""
    return f"{int(number):,}".replace(",", THIN) if number >= 1000 else f"{number:g}"


def factor(number: float) -> str:
    """Return how many times something is, to two figures."""
    return plain(float(f"{number:.2g}"))


PLAIN = FuncFormatter(lambda number, _: plain(number))


def is_ours(method: str) -> bool:
    """Whether a method is the library's own."""
    return method in NAMES


def name_of(method: str) -> str:
    """Return what a method is called in pictures."""
    return NAMES.get(method) or PEERS.get(method, method)


def spoken(method: str) -> str:
    """Return what a method is called in a sentence."""
    return name_of(method).replace("jfrnn, ", "jfrnn's ")


def choose(methods: Iterable[str]) -> list[str]:
    """Return at most eight of the methods: three of ours, others that people know, then what is left; ours first."""
    present = list(dict.fromkeys(methods))
    ours = [name for name in NAMES if name in present][:3]
    others = [*(name for name in PEERS if name in present), *(name for name in present if name not in NAMES and name not in PEERS)]
    others = others[: MOST - len(ours)]
    more = [name for name in NAMES if name in present and name not in ours][: MOST - len(ours) - len(others)]
    return [*ours, *more, *others]


def color_of(method: str, methods: Sequence[str]) -> str:
    """Return the color of a method among those of a picture: blue if it is ours, of two others never the same."""
    peers = [name for name in methods if not is_ours(name)]
    return OURS if is_ours(method) else PEERS_COLORS[peers.index(method) % len(PEERS_COLORS)]


def make_axes(title: str, height: float) -> tuple[Figure, Axes]:
    """Return a figure as wide as a page, and its axes under a title."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    axes = figure.add_subplot()
    clear(axes)
    head(figure, title)
    return figure, axes


def head(figure: Figure, title: str) -> None:
    """Write what is to be seen above a figure, in lines as wide as it."""
    figure.suptitle(fill(title, 74), x=0.015, ha="left", fontsize=11, fontweight="bold")


def clear(axes: Axes) -> None:
    """Leave of the frame what bears numbers, and a faint grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(True, which="major", color="0.92", linewidth=0.8)
    axes.set_axisbelow(True)


def label_logarithmic(axis: Axis, short: float = 1000) -> None:
    """Write plain numbers at the powers of ten, and at 2 and 5 times these where an axis ends below `short` times its begin."""
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < short * low else (1,)))
    axis.set_major_formatter(PLAIN)
    axis.set_minor_formatter(NullFormatter())


def dress(axes: Axes, xlabel: str, ylabel: str) -> None:
    """Make both axes logarithmic and name them."""
    axes.set(xscale="log", yscale="log", xlabel=xlabel, ylabel=ylabel)
    for axis, short in ((axes.xaxis, 100), (axes.yaxis, 1000)):  # numbers side by side take more room
        label_logarithmic(axis, short)
    clear(axes)


_LEADER = {"arrowstyle": "-", "color": "0.75", "lw": 0.6, "shrinkA": 1, "shrinkB": 2, "relpos": (0, 0.5)}  # to where a name begins


def write_names(axes: Axes, ends: Sequence[tuple[str, float, float, str]]) -> None:
    """Write names beside the right edge of the axes, each as high as its line ends and none upon another, with a thin line to it.

    Of each line, `ends` has the name, x and y of the last mark, and the color; the limits of the axes are final.
    """
    if not ends:
        return
    axes.get_xbound()  # Matplotlib chooses limits of both axes when they are asked for, and transforms do not ask
    to_share = axes.transData + axes.transAxes.inverted()
    places = sorted((float(to_share.transform((x, y))[1]), name, x, y, color) for name, x, y, color in ends)
    tall = axes.get_window_extent().height / axes.figure.dpi  # before the layout makes room for titles and labels
    step = min(0.19 / tall, 1 / len(places))
    heights: list[float] = []
    for share, *_ in places:
        heights.append(max(share, heights[-1] + step) if heights else max(share, 0.0))
    for k in range(len(heights) - 1, -1, -1):  # what is above the axes comes down, and pushes what is below
        heights[k] = min(heights[k], heights[k + 1] - step if k + 1 < len(heights) else 1.0)
    both = blended_transform_factory(axes.transAxes, axes.transAxes)
    for height, (_, name, x, y, color) in zip(heights, places, strict=True):
        weight = "bold" if color == OURS else "normal"
        axes.annotate(
            name,
            *((x, y), (1.03, height)),
            **{"xycoords": "data", "textcoords": both, "va": "center", "ha": "left", "color": color, "fontsize": 9},
            **{"fontweight": weight, "arrowprops": _LEADER},
            annotation_clip=False,
        )


def write_names_near(figure: Figure, axes: Axes, marks: Sequence[tuple[str, float, float, str]]) -> None:
    """Write the name of each mark where neither a mark nor another name is: right, left, above or below, then further off.

    Marks are names, x, y and colors. All else that takes room is complete, and the limits of the axes are final.
    """
    figure.draw_without_rendering()
    points = [axes.transData.transform((x, y)) for _, x, y, _ in marks]
    scale = figure.dpi / 72  # pixels per point
    taken = [Bbox([point - 6 * scale, point + 6 * scale]) for point in points]
    for (name, x, y, color), point in zip(marks, points, strict=True):
        text = axes.annotate(name, (x, y), (0, 0), textcoords="offset points", color=color, fontsize=9, va="center", ha="center")
        text.set_fontweight("bold" if color == OURS else "normal")
        size = np.array(text.get_window_extent().size)
        across, up = 10 * scale + size[0] / 2, 9 * scale + size[1] / 2
        step = 1.1 * size[1]
        places = [(side * across, k * step) for k in (0, 1, -1, 2, -2, 3, -3) for side in (1, -1)]
        places[2:2] = [(0.0, up), (0.0, -up)]
        boxes = [Bbox([point + place - size / 2, point + place + size / 2]) for place in places]
        free = [k for k, box in enumerate(boxes) if axes.bbox.containsx(box.x0) and axes.bbox.containsx(box.x1)]
        free = [k for k in free if axes.bbox.y0 <= boxes[k].y0 and boxes[k].y1 <= axes.bbox.y1] or free or [0]
        k = next((k for k in free if not boxes[k].count_overlaps(taken)), free[0])
        text.set_position((places[k][0] / scale, places[k][1] / scale))
        taken.append(boxes[k])


def headline(found: dict[str, dict[str, float]], what: str, scenes: str = "scenes", beside: bool = False) -> str:
    """Say where our list stands among those of others, with factors.

    Of each scene, `found` has the seconds (`fast`) or bytes (`lean`) of each method that the picture shows. Times measured `beside`
    other work, or where nobody knows, do not tell which method is first.
    """
    if beside and what == "fast":
        return "Time of a search, measured beside other work or too briefly: who is first is not said"
    lists = {scene: {name: value for name, value in of.items() if name not in WITHOUT_LIST} for scene, of in found.items()}
    lists = lists if any(len(of) > 1 for of in lists.values()) else found
    present = {name for of in lists.values() for name in of}
    ours = next((name for name in LEADING if name in present), None)
    both = {scene: of for scene, of in lists.items() if ours in of and any(not is_ours(name) for name in of)}
    if ours is None or not both:
        first = Counter(min(of, key=lambda name: of[name]) for of in lists.values() if of).most_common(1)
        rest = f": {spoken(first[0][0])} is first in {first[0][1]} of {len(lists)} {scenes}" if len(present) > 1 else ""
        return f"{'Time' if what == 'fast' else 'Memory'} of a search{rest}"
    rivals = {scene: min((v, name) for name, v in of.items() if not is_ours(name)) for scene, of in both.items()}
    ratios = [value / both[scene][ours] for scene, (value, _) in rivals.items()]
    names = [name for name, _ in Counter(name for _, name in rivals.values()).most_common()]
    rival = name_of(names[0]) if len(names) == 1 else f"{', '.join(map(name_of, names[:-1]))} or {name_of(names[-1])}"
    rival = rival if len(names) < 4 else "one method or another"
    kind = spoken(ours)
    low, high = (factor(edge(ratios)) for edge in (min, max))
    span = low if low == high else f"{low} to {high}"
    where = f"on {'all ' if len(both) > 1 else ''}{len(both)} {scenes}" if len(both) > 1 else "on this scene"
    if what == "lean":
        least, most = (factor(1 / edge(ratios)) for edge in (max, min))
        return f"{kind} takes {least if least == most else f'{least} to {most}'} times the memory of the leanest other, {rival}"
    if min(ratios) > 1:
        return f"{kind} is {span} times as fast as the next, {rival}, {where}"
    wins = sum(ratio > 1 for ratio in ratios)
    return (
        f"{kind} is first on {wins} of {len(both)} {scenes}, up to {high} times as fast as the next; "
        f"elsewhere up to {factor(1 / min(ratios))} times as slow as {rival}"
    )
