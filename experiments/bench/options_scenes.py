"""What `bench options` times: a plain search, the same with one option at a time, and what each of them is compared with."""

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

import jfrnn
from experiments import _machine

NEIGHBORS = 30  # about so many each, away from the faces of the unit cube
SMOOTH = 57  # neighbors within a smoothing length
FACTORS = (2, 4, 10, 30, 100)  # of the largest cutoff over the least
FIRST, LARGEST, AS_MANY = "the first row", "the largest cutoff for all", "one cutoff, as many pairs"
WITHOUT_FAR, MOVED = "the same without the far ones", "the same sites moved at random"
_SAMPLED = 5000  # particles whose neighbors tell how many pairs a cutoff makes
_OPEN, _RULES = "open, whole list", ("gather", "scatter", "either", "both", "mean")


class Asked(NamedTuple):
    """A question: positions [n, 3], cutoffs, what else goes to `search` and `count`, and a sum that replaces all of these.

    Attributes:
        peers: Whether SciPy and `wp.HashGrid` can answer it: open space, and the cutoff of the query decides.
        alone: Makes a sum of positions, masses and a backend, where an option is one of sums alone.
    """

    x: Any
    cutoff: Any
    more: dict[str, Any]
    peers: bool = False
    alone: Callable[[Any, Any, Any], Any] | None = None

    @property
    def spread(self) -> float | None:
        """The largest cutoff over the least, where each particle has its own."""
        return None if np.ndim(self.cutoff) != 1 else float(f"{float(self.cutoff.max() / self.cutoff.min()):.3g}")


class Option(NamedTuple):
    """One way to search: its name, what makes it for n particles, and what it is compared with."""

    name: str
    make: Callable[[int], Asked]
    beside: str = FIRST


def beside(option: Option, asked: Asked, pairs: int) -> Asked:
    """Return the question that an option is compared with, which has so many pairs itself."""
    if option.beside == AS_MANY:
        return Asked(asked.x, _radius_of(asked, pairs), {})
    makers = {WITHOUT_FAR: partial(_smooth, _uniform), MOVED: partial(_lattice, 1.0, moved=True)}
    return makers.get(option.beside, _plain)(len(asked.x))


def options() -> list[Option]:
    """Return all options, the plain search first."""
    rest = [Option(name, partial(_with, name)) for name in _KINDS]
    rest.append(Option("ten far away", lambda n: _plain(n)._replace(x=jnp.asarray(_far(n)))))
    rest.append(Option("sum, the largest term", partial(_sum_alone, _largest)))
    rest.append(Option("sum, a table indexed by species", partial(_sum_alone, _by_species)))
    rest.append(Option("a cutoff per particle, equal", lambda n: _own(_uniform(n), np.full(n, _radius(n))), AS_MANY))
    rest += [Option(f"a cutoff per particle within a factor of 2, {rule}", partial(_two, rule), AS_MANY) for rule in _RULES]
    rest.append(Option("a cutoff per pair of two species", _species, LARGEST))
    rest += [Option(f"cutoffs over a factor of {factor}, uniform points", partial(_spread, factor), AS_MANY) for factor in FACTORS]
    shapes = {"uniform": _uniform, "a surface": _surface, "a line": _line, "a Plummer sphere": _plummer}
    rest += [Option(f"{SMOOTH} neighbors each, {name}", partial(_smooth, points), AS_MANY) for name, points in shapes.items()]
    rest.append(Option(f"{SMOOTH} neighbors each, uniform, ten far away", partial(_smooth, _far), WITHOUT_FAR))
    rest += [Option(f"two cutoffs, ties, spacing {spacing:g}", partial(_lattice, spacing), MOVED) for spacing in (1.0, 1e-4)]
    rest += [Option(f"a cutoff per particle over a factor of 100, {rule}", partial(_graded, rule)) for rule in ("gather", "either")]
    return [Option(_OPEN, _plain), *rest]


# --- a plain search, and options of it ----------------------------------------------------------------------------------------


def _uniform(n: int) -> np.ndarray:
    return np.random.default_rng(0).random((n, 3)).astype(np.float32)


def _radius(n: int) -> float:
    return float(np.float32((3 * NEIGHBORS / (4 * math.pi * n)) ** (1 / 3)))


def _plain(n: int) -> Asked:
    return Asked(jnp.asarray(_uniform(n)), _radius(n), {}, peers=True)


_SYSTEMS = 100
_KINDS: dict[str, Callable[[np.random.Generator, int], dict[str, Any]]] = {
    "half": lambda _, n: {"half": True},
    "closed": lambda _, n: {"closed": True},
    "include_self": lambda _, n: {"include_self": True},
    "float64": lambda _, n: {},
    "as many queries": lambda random, n: {"queries": jnp.asarray(random.random((n, 3)), jnp.float32)},
    "a tenth inactive": lambda random, n: {"active": jnp.asarray(random.random(n) < 0.9)},
    "a tenth active": lambda random, n: {"active": jnp.asarray(random.random(n) < 0.1)},
    "skin of a tenth": lambda _, n: {"skin": 0.1 * _radius(n)},
    "list with reverse slots": lambda _, n: {"reverse": True},
    "flat list of edges": lambda _, n: {"flat": True},
    "excluded pairs": lambda _, n: {"exclude": np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)},  # a chain
    "box, periodic": lambda _, n: {"box": jfrnn.Box([1.0, 1.0, 1.0])},
    "box, periodic along x": lambda _, n: {"box": jfrnn.Box([1.0, 1.0, 1.0], (True, False, False))},
    "box, skewed": lambda _, n: {"box": jfrnn.Box(np.eye(3) + np.diag([0.3, 0.3], 1))},
    "box, images told apart": lambda _, n: {"box": jfrnn.Box([1.0, 1.0, 1.0], images=1)},
    "batch of 100 systems, superposed": lambda random, n: {"batch": _systems(random, n)},
    "batch of 100 systems, a box for each": lambda random, n: {
        "batch": _systems(random, n),
        "box": jfrnn.Box(np.tile(np.eye(3), (_SYSTEMS, 1, 1))),
    },
}


def _systems(random: np.random.Generator, n: int) -> jax.Array:
    return jnp.asarray(random.integers(0, _SYSTEMS, n), jnp.int32)


def _with(name: str, n: int) -> Asked:
    more, plain = _KINDS[name](np.random.default_rng(1), n), _plain(n)
    x = jnp.asarray(plain.x, jnp.float64) if name == "float64" else plain.x
    return Asked(x, plain.cutoff * (_SYSTEMS ** (1 / 3) if "batch" in more else 1), more)


def _sum_alone(make: Callable[[int], Callable[[Any, Any, Any], Any]], n: int) -> Asked:
    return _plain(n)._replace(alone=make(n), peers=False)


def density(r: jax.Array, i: jax.Array, j: jax.Array) -> jax.Array:
    """Return the summand of all sums: a mass times the kernel poly6, for a smoothing length of 1 and without its factor."""
    return j * jnp.maximum(1 - r @ r, 0) ** 3


def _largest(n: int) -> Callable[[Any, Any, Any], Any]:
    return lambda x, masses, backend: jfrnn.pair_sum(density, x, _radius(n), masses, reduce="max", backend=backend)


def _by_species(n: int) -> Callable[[Any, Any, Any], Any]:
    species = jnp.asarray(np.random.default_rng(1).integers(0, 2, n), jnp.int32)
    table = jnp.asarray([[1.0, 0.75], [0.75, 0.5]], jnp.float32)

    def term(r: jax.Array, i: dict[str, jax.Array], j: dict[str, jax.Array]) -> jax.Array:
        return table[i["s"], j["s"]] * density(r, i["m"], j["m"])

    return lambda x, masses, backend: jfrnn.pair_sum(term, x, _radius(n), {"m": masses, "s": species}, backend=backend)


# --- cutoffs of many kinds ----------------------------------------------------------------------------------------------------


def _own(x: np.ndarray, cutoffs: np.ndarray, rule: str = "gather") -> Asked:
    more = {} if rule == "gather" else {"radius_rule": rule}
    return Asked(jnp.asarray(x, jnp.float32), jnp.asarray(cutoffs, jnp.float32), more, peers=rule == "gather")


def _two(rule: str, n: int) -> Asked:
    return _own(_uniform(n), _radius(n) * np.random.default_rng(1).uniform(2 / 3, 4 / 3, n), rule)


def _species(n: int) -> Asked:
    r, kinds = _radius(n), np.random.default_rng(1).integers(0, 2, n)
    cutoffs = [[r, 0.75 * r], [0.75 * r, 0.5 * r]]  # known, as one cutoff is
    return Asked(jnp.asarray(_uniform(n)), cutoffs, {"species": jnp.asarray(kinds, jnp.int32)})


def _spread(factor: int, n: int) -> Asked:
    """Return uniform points with cutoffs over a factor, their logarithms uniform, with as many pairs whatever it is."""
    logs = np.linspace(0, math.log(factor), n)  # evenly spaced, so that the factor is exactly this one
    cutoffs = np.random.default_rng(1).permutation(np.exp(logs))
    return _own(_uniform(n), _radius(n) * cutoffs / np.mean(cutoffs**3) ** (1 / 3))


def _graded(rule: str, n: int) -> Asked:
    """Return points whose density goes with distance^-3 over a factor of 100, and cutoffs with about 30 neighbors."""
    distance = 10.0 ** np.random.default_rng(1).uniform(-2, 0, n)
    return _own(distance[:, None] * _surface(n), (3 * NEIGHBORS * math.log(100) / n) ** (1 / 3) * distance, rule)


def _surface(n: int) -> np.ndarray:
    away = np.random.default_rng(0).normal(size=(n, 3))
    return away / np.linalg.norm(away, axis=1, keepdims=True)


def _line(n: int) -> np.ndarray:
    return np.random.default_rng(0).random((n, 1)) * [1.0, 0.0, 0.0]


def _plummer(n: int) -> np.ndarray:
    """Return points of the sphere of Plummer (1911), scale radius 1: its enclosed mass r^3 (1 + r^2)^(-3/2) is uniform."""
    enclosed = np.random.default_rng(1).random(n)
    return _surface(n) / np.sqrt(enclosed ** (-2 / 3) - 1)[:, None]


def _far(n: int) -> np.ndarray:
    x = _uniform(n)
    x[:10] = 1e4 * np.random.default_rng(1).normal(size=(10, 3))
    return x


def _smooth(points: Callable[[int], np.ndarray], n: int) -> Asked:
    """Return points and smoothing lengths, each in the middle between its 57th and 58th neighbor."""
    x = points(n).astype(np.float32)
    near = KDTree(x).query(x, SMOOTH + 2, workers=_machine.machine()["cores"])[0]
    return _own(x, near[:, SMOOTH:].mean(axis=1))


def _lattice(spacing: float, n: int, moved: bool = False) -> Asked:
    """Return about n sites of a cube in random order and cutoffs of 2 or 3 spacings, at which 6 or 30 sites are."""
    random, side = np.random.default_rng(1), round(n ** (1 / 3))
    sites = random.permutation(np.stack(np.meshgrid(*[np.arange(side)] * 3, indexing="ij"), axis=-1).reshape(-1, 3))
    cutoffs = random.integers(2, 4, len(sites)) * spacing
    return _own((sites + (random.uniform(-0.3, 0.3, sites.shape) if moved else 0)) * spacing, cutoffs)


def _radius_of(asked: Asked, pairs: int) -> float:
    """Return the one cutoff with about so many pairs, from the neighbors of some of the particles."""
    x, cutoffs = np.asarray(asked.x), np.asarray(asked.cutoff, np.float64)
    if cutoffs.min() == cutoffs.max():
        return float(cutoffs[0])
    everywhere, some = KDTree(x), KDTree(x[:: -(-len(x) // _SAMPLED)])
    wanted = (pairs / len(x) + 1) * some.n  # each is found itself, too

    def few(cutoff: float) -> bool:
        return int(some.count_neighbors(everywhere, cutoff)) < wanted

    low = high = float(np.median(cutoffs))  # the largest ones may reach everything, which takes long to count
    while few(high):
        low, high = high, 2 * high
    while not few(low):
        low, high = low / 2, low
    while high > 1.001 * low:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if few(middle) else (low, middle)
    return float(np.float32(high))
