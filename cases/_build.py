"""Scenes by name."""

import inspect
import re
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ._check import float_dtype, whole
from ._domain import Domain
from ._scatter import clump, filament, jitter, random, sheet, two_blobs
from ._scene import Scene
from ._thesis import clusters, corners, diagonal, full
from ._turned import cut, grown, tumbled, turned

Layout = Callable[..., NDArray[np.float64]]

_BY_NAME: dict[str, Layout] = {
    "full": full,
    **{f"clusters{tiles}": partial(clusters, tiles=tiles) for tiles in (2, 4, 5, 6, 10, 20)},
    "corners": corners,
    "diagonal": diagonal,
    "random": random,
    "jitter": jitter,
    "two-blobs": two_blobs,
    "clump": clump,
    "sheet": sheet,
    "filament": filament,
}

LAYOUTS = tuple(_BY_NAME)
"""Names that `scene` knows. It builds clustersN for any other N too, and those of `FAMILIES`."""

FAMILIES: dict[str, Layout] = {"clusters": clusters, "turned": turned, "tumbled": tumbled, "cut": cut, "grown": grown}
"""Layouts of N tiles per axis, by what stands before the N: clusters5, turned4."""


def scene(
    name: str,
    *,
    fill: float | None = None,
    spacing: float = 1e-4,
    cutoff_ratio: float = 3.0,
    dim: int = 3,
    dtype: str | type | np.dtype = "float32",
    seed: int = 0,
    n: int | None = None,
    separation: float | None = None,
    amplitude: float | None = None,
    density: float | None = None,
    angle: float | None = None,
    growth: float | None = None,
) -> Scene:
    """Build a scene by the name of its layout.

    Positions are computed in float64 and rounded once. An argument left at None takes the default of the layout,
    and one that the layout does not know is refused. The function of each layout says what it does with them.

    >>> corners = scene("corners", fill=0.14)
    >>> corners.n, corners.fill
    (37044, 0.148176)

    Args:
        name: One of `LAYOUTS`, or "clustersN", "turnedN", "tumbledN", "cutN" or "grownN" with any whole number N of tiles per axis.
        fill: Points / sites of the full domain, in (0, 1]. The fill that was reached is in the result.
        spacing: Distance of neighboring lattice sites [m]; the domain stays 0.005 m × 0.01 m × 0.005 m.
        cutoff_ratio: Cutoff in units of the spacing.
        dim: 3, or 2 for the x-y plane alone.
        dtype: float32 or float64.
        seed: Seed of the layouts that draw (random, jitter, clump, tumbledN); the others need none.
        n: Number of points instead of `fill`: random, two-blobs, clump.
        separation: Gap of two-blobs in cutoffs.
        amplitude: Displacement of jitter in units of the spacing.
        density: Points per lattice site in a clump.
        angle: Of turnedN and cutN [degrees].
        growth: Of the domain of grownN: how many times larger it is. The fill counts that.

    Returns:
        The scene. Its lengths are those of the domain, or of the box around two-blobs and grownN, which outgrow it.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: The name is unknown, or an argument is out of range or not one of this layout.
    """
    layout = _layout(name)
    domain = Domain(spacing, cutoff_ratio, dim)
    rounded = float_dtype("dtype", dtype)
    whole("seed", seed, 0)
    options = {"fill": fill, "n": n, "separation": separation, "amplitude": amplitude, "density": density}
    options |= {"angle": angle, "growth": growth}
    exact = layout(domain, **_accepted(name, layout, {k: v for k, v in options.items() if v is not None}, seed))
    around = tuple((exact.max(axis=0) + domain.spacing).tolist())
    return Scene(
        name=name,
        positions=exact.astype(rounded),
        cutoff=domain.cutoff,
        spacing=domain.spacing,
        lengths=around if layout is two_blobs or growth is not None else domain.lengths,
        fill=len(exact) / domain.size / (growth or 1.0),
        exact=exact,
    )


def _layout(name: str) -> Layout:
    """Find the layout of a name, or raise with the names that exist."""
    numbered = re.fullmatch(rf"({'|'.join(FAMILIES)})([1-9][0-9]{{0,8}})", str(name))
    if numbered:
        return partial(FAMILIES[numbered[1]], tiles=int(numbered[2]))
    if name not in _BY_NAME:
        numbered_names = ", ".join(f"{family}N" for family in FAMILIES)
        raise ValueError(f"name must be a known layout, got {name!r}: take one of {', '.join(LAYOUTS)}, or {numbered_names}.")
    return _BY_NAME[name]


def _accepted(name: str, layout: Layout, given: dict[str, float], seed: int) -> dict[str, float]:
    """Add the seed where the layout draws, and refuse what its signature does not have."""
    known = [key for key in inspect.signature(layout).parameters if key not in ("domain", "tiles")]
    for key, value in given.items():
        if key not in known:
            raise ValueError(f"{key}={value!r} is not an argument of the layout {name!r}, which takes {', '.join(known)}: drop it.")
    return given | ({"seed": seed} if "seed" in known else {})
