"""What benches of lists share: a scene, ways to search it and to sum over it, lists of others, and how a wrong answer is seen."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import jfrnn
from experiments._library import round_capacity
from experiments.bench import ways

LOOKED_AT = 50_000  # rows of a list in which distances are looked at, if there are more
SUMMED = 2000  # particles whose sums are compared
Function = Callable[[Array], Any]


class Scene(NamedTuple):
    """Positions in float32, a cutoff, and the number of neighbors of each particle, which a tree found in float64."""

    x: Array
    cutoff: float
    counts: np.ndarray

    @property
    def capacity(self) -> int:
        """Slots of a row."""
        return round_capacity(int(self.counts.max()))


def make_scene(points: np.ndarray, cutoff: float) -> Scene:
    """Return the scene of such points, whose coordinates float32 has."""
    from scipy.spatial import KDTree

    x, below = points.astype(np.float64), np.nextafter(cutoff, 0)  # a tree counts those at the radius
    counts = KDTree(x).query_ball_point(x, below, return_length=True, workers=-1) - 1
    return Scene(jnp.asarray(x, jnp.float32), cutoff, counts)


# --- ways -------------------------------------------------------------------------------------------------------------


def search(scene: Scene, **options: Any) -> Function:  # noqa: ANN401
    """Return what lists the neighbors of positions, with options of `jfrnn.search`."""

    def find(x: Array) -> tuple[Array, Array]:
        nbrs = jfrnn.search(x, scene.cutoff, capacity=scene.capacity, **options)
        return nbrs.idx, nbrs.count

    return find


def count(scene: Scene, **options: Any) -> Function:  # noqa: ANN401
    """Return what counts them."""
    return lambda x: jfrnn.count(x, scene.cutoff, **options)


def density(scene: Scene, **options: Any) -> Function:  # noqa: ANN401
    """Return what sums (1 - r²/cutoff²)³ over them."""

    def kernel(r: Array, _i: None, _j: None) -> Array:
        return jnp.maximum(1 - (r @ r) / scene.cutoff**2, 0) ** 3

    return lambda x: jfrnn.pair_sum(kernel, x, scene.cutoff, **options)


def density_and_gradient(scene: Scene, **options: Any) -> Function:  # noqa: ANN401
    """Return what finds that density, and the gradient of the sum of all densities."""

    def both(x: Array) -> tuple[Array, Array]:
        found, back = jax.vjp(density(scene, **options), x)
        return found, back(jnp.ones_like(found))[0]

    return both


def jax_md(scene: Scene, sparse: bool = False) -> Function:
    """Return jax-md's list, dense or sparse."""
    from experiments.methods import jax_md

    return jax_md.compile_update(scene.x, scene.cutoff, jax_md.allocate(np.asarray(scene.x), scene.cutoff, sparse))


def nvalchemi(scene: Scene, strategy: str | None = None) -> Function:
    """Return nvalchemi's list, made by cells, or of all pairs by a strategy."""
    from experiments.methods import nvalchemi

    if strategy is None:
        return nvalchemi.compile_search(scene.x, scene.cutoff, scene.capacity)
    return nvalchemi.compile_naive(scene.cutoff, scene.capacity, strategy)


# --- right or wrong ---------------------------------------------------------------------------------------------------


def wrong_rows(scene: Scene, found: tuple[Array, Array | None]) -> int:
    """Count the particles whose rows are not the right number of different neighbors within the cutoff, by float64.

    All rows have to have the right number; if there are many, distances are looked at in evenly chosen ones.
    """
    n, x, rows = len(scene.x), np.asarray(scene.x, np.float64), np.asarray(found[0])
    right = (rows < n).sum(axis=1) == scene.counts
    chosen = np.linspace(0, n - 1, min(n, LOOKED_AT)).astype(int)
    for some in np.array_split(chosen, -(-len(chosen) // 20_000)):
        idx = np.sort(rows[some], axis=1)
        good, used = ((idx[:, 1:] > idx[:, :-1]) | (idx[:, 1:] >= n)).all(axis=1), idx < n
        apart = np.square(x[np.where(used, idx, 0)] - x[some, None]).sum(axis=2)
        right[some] &= good & (~used | ((apart < scene.cutoff**2) & (idx != some[:, None]))).all(axis=1)
    return int((~right).sum()) + (0 if found[1] is None else wrong_counts(scene, found[1]))


def wrong_counts(scene: Scene, found: Any) -> int:  # noqa: ANN401
    """Count the particles whose numbers of neighbors are others."""
    return int((scene.counts != np.asarray(found)).sum())


def wrong_counts_of_pairs(scene: Scene, idx: Array) -> int:
    """Count the same in a list of pairs [2, capacity]."""
    n, senders = len(scene.x), np.asarray(idx)[0]
    return wrong_counts(scene, np.bincount(senders[senders < n], minlength=n))


def wrong_density(scene: Scene, found: Array) -> int:
    """Count the particles whose density, of evenly chosen ones, is farther from that in float64 than rounding explains."""
    return _wrong_sums(scene, [found])


def wrong_gradient(scene: Scene, found: tuple[Array, Array]) -> int:
    """Count the same of the density and of the gradient of all densities."""
    return _wrong_sums(scene, found)


def _wrong_sums(scene: Scene, found: Any) -> int:  # noqa: ANN401
    """Count the chosen particles of which one sum or another is off."""
    n, h = len(scene.x), scene.cutoff
    chosen, wrong = np.linspace(0, n - 1, min(n, SUMMED)).astype(int), 0
    exact = ways.reference(ways.Given(scene.x, np.ones(n), h), chosen, True)[0] / ways.poly6_scale(h)
    for theirs, ours in zip(found, (exact[:, 0], exact[:, 1:]), strict=False):
        near = np.abs(np.asarray(theirs)[chosen] - ours) <= 1e-5 * np.abs(ours).max()
        wrong += int((~near).reshape(len(chosen), -1).any(axis=1).sum())
    return wrong
