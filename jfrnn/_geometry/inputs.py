"""Argument checks while tracing: each error names the argument, what it was, what was expected and what to do."""

import math
from numbers import Real as AnyReal
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jax.tree_util import KeyPath

from jfrnn._geometry.batch import Batch
from jfrnn._geometry.box import Box, check_box_range
from jfrnn._geometry.cutoffs import ALIKE, RANGE_OF, RULES, SUM, TABLE, Radii, is_radius
from jfrnn._tracing import Given, Real, Tree, as_array, as_dtype, gather, make_on_host, on_device, refuse_forks

_MOST_POINTS = 2**31 - 32
_MOST_SLOTS_OF_ROW = 2**31 - 1
_MOST_KINDS = 2**12  # places in a table of their cutoffs are whole floats, too


def refuse_rounding(name: str) -> None:
    """Raise for arrays of float64 where JAX has none."""
    if not jax.config.read("jax_enable_x64"):
        raise TypeError(
            f"{name} are float64, but JAX's 64-bit mode is off and would round them to float32 in silence: call "
            f'jax.config.update("jax_enable_x64", True) at start-up, or pass {name}.astype(np.float32).'
        )


def refuse_wrapping(name: str, integers: np.ndarray) -> None:
    """Raise for integers of 64 bits that do not fit into 32 where JAX has no others."""
    kind = integers.dtype
    if kind.kind not in "iu" or kind.itemsize < 8 or not integers.size or jax.config.read("jax_enable_x64"):
        return
    least, most, room = int(integers.min()), int(integers.max()), np.iinfo(f"{kind.kind}4")
    if not room.min <= least <= most <= room.max:
        raise ValueError(
            f"{name} holds {kind} from {least} to {most}, but JAX's 64-bit mode is off and would wrap them around in silence: call "
            f'jax.config.update("jax_enable_x64", True) at start-up, or pass integers that {room.dtype} can hold.'
        )


def check_positions(name: str, positions: Given, like: Array | None = None, numbers: np.dtype | type[float] = float) -> Array:
    """Return positions as a float32 or float64 array [n, 2] or [n, 3]; with `like`, of the same dtype and dimension.

    A list of numbers becomes an array of the dtype `numbers`, or that of `like`.
    """
    refuse_forks()
    if hasattr(positions, "positions"):
        raise TypeError(
            f"{name} must be a JAX or NumPy array of shape [n, 2] or [n, 3], got {type(positions).__name__}, which has one: pass "
            f"atoms.positions, with a cell box=jfrnn.Box(atoms.cell[:], periodic=atoms.pbc), or call jfrnn.ase.neighbor_list."
        )
    positions = as_array(name, positions, numbers if like is None else np.dtype(like.dtype))
    if not hasattr(positions, "dtype") or not hasattr(positions, "shape"):
        raise TypeError(
            f"{name} must be a JAX or NumPy array of shape [n, 2] or [n, 3], got {type(positions).__name__}: "
            f"convert it with jnp.asarray({name}, dtype=jnp.float32)."
        )
    dtype, shape = np.dtype(positions.dtype), tuple(positions.shape)
    if dtype not in (np.float32, np.float64):
        raise TypeError(f"{name} must be float32 or float64, got {dtype}: convert them first, e.g. with .astype(jnp.float32).")
    if dtype == np.float64:
        refuse_rounding(name)
    if len(shape) != 2 or shape[1] not in (2, 3):
        turned = f": pass {name}.T" if len(shape) == 2 and shape[0] in (2, 3) else ""
        raise ValueError(f"{name} must have shape [n, 2] or [n, 3], one row per particle, got shape {list(shape)}{turned}.")
    if shape[0] > _MOST_POINTS:
        raise ValueError(f"{name} hold {shape[0]} particles, but indices are int32: at most {_MOST_POINTS}.")
    if like is not None and (dtype, shape[1]) != (like.dtype, like.shape[1]):
        raise ValueError(
            f"{name} must match positions ({like.dtype}, {like.shape[1]} columns), got {dtype} with {shape[1]} columns."
        )
    return on_device(positions)  # stays concrete inside jit, so that `search` can count its neighbors


def check_again(
    name: str, positions: Given, dtype: np.dtype, dim: int, rows: int, made: Array | None, what: str = "the list"
) -> Array:
    """Return positions, after checking that they have the dtype, dimension and number that e.g. a list was made for.

    They have to lie on the devices of `made`, an array of it, if that is given.
    """
    points = check_positions(name, positions, numbers=np.dtype(dtype))
    if (points.dtype, points.shape[1]) != (dtype, dim):
        raise ValueError(
            f"{name} must be {dtype} with {dim} columns, for which {what} was made, got {points.dtype} with {points.shape[1]} "
            f"columns: convert them, e.g. with .astype(jnp.{dtype}), or make {what} anew."
        )
    if points.shape[0] != rows:
        noun = {"queries": "points", "vertices": "corners"}.get(name, "particles")
        raise ValueError(
            f"{name} hold {points.shape[0]} {noun}, but {what} was made for {rows}: make it anew for as many as there are."
        )
    if made is not None:
        check_devices(name, points, made)
    return points


def check_devices(name: str, given: Given, made: Given) -> None:
    """Raise if an array and an earlier result are committed to different devices; traced values are not checked."""
    if isinstance(given, Tracer) or isinstance(made, Tracer):
        return
    if not (getattr(given, "committed", False) and getattr(made, "committed", False)) or given.devices() == made.devices():
        return
    here, there = (", ".join(sorted(map(str, x.devices()))) for x in (given, made))
    raise ValueError(
        f"{name} lie on {here}, but the list on {there}: move one of them with jax.device_put, or make the list anew where {name} "
        "lie. Over several devices, see jfrnn.distributed."
    )


def is_real(given: Given) -> bool:
    """Say whether this is a real number, or an array of them; a bool is none."""
    kind = getattr(given, "dtype", None)
    if kind is None:
        return isinstance(given, AnyReal) and not isinstance(given, bool)
    return any(jnp.issubdtype(kind, reals) for reals in (np.floating, np.integer))


def check_cutoff(cutoff: Given, dtype: np.dtype, instead: str = "") -> float:
    """Return one cutoff for all particles, rounded to the dtype of the positions; `instead`: what else may be traced."""
    if isinstance(cutoff, Tracer):
        raise TypeError(
            "cutoff must be a static number, got a traced value: pass a Python float, or mark the argument with "
            f"jax.jit(..., static_argnames='cutoff'){instead}."
        )
    if np.ndim(cutoff) != 0:
        raise ValueError(f"cutoff must be one number, got an array of shape {list(np.shape(cutoff))}.")
    if not is_real(cutoff):
        raise TypeError(f"cutoff must be a number, got {getattr(cutoff, 'dtype', type(cutoff).__name__)}.")
    value = float(cutoff)
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"cutoff must be positive and finite, got {value}.")
    low, high = RANGE_OF[dtype]
    if not low <= value <= high:
        raise ValueError(
            f"cutoff={value} is outside [{low:.1e}, {high:.1e}], the range in which {dtype} decides pairs exactly: "
            "choose another unit of length, or float64."
        )
    return float(dtype.type(value))


def check_radii(cutoff: Given, rule: object, sources: Array, queries: Array | None) -> Radii | None:
    """Return cutoffs per particle in the dtype of the positions, or None if the cutoff is one number."""
    if rule not in (*RULES, SUM):
        raise ValueError(f"radius_rule must be one of {', '.join(map(repr, (*RULES, SUM)))}, got {rule!r}.")
    summed, rule = rule == SUM, "mean" if rule == SUM else str(rule)
    cutoff = cutoff if isinstance(cutoff, tuple | list) else as_array("cutoff", cutoff)
    if not isinstance(cutoff, tuple | list) and np.ndim(cutoff) == 2:
        raise ValueError(
            f"cutoff has shape {list(np.shape(cutoff))}, that of a table of cutoffs of pairs of species: pass species=, that of "
            "each particle, with it."
        )
    if not isinstance(cutoff, tuple | list) and np.ndim(cutoff) == 0:
        if summed:
            raise ValueError(f"radius_rule='sum' adds radii of particles: pass an array of them, got {_describe(cutoff)}.")
        return None
    n, m = sources.shape[0], None if queries is None else queries.shape[0]
    if m is None:
        radii = _check_radii_of("cutoff", cutoff, n, "particle", sources, summed)
        return Radii(None if rule == "gather" else radii, None if rule == "scatter" else radii, rule, summed)
    if rule == "gather":
        return Radii(None, _check_radii_of("cutoff", cutoff, m, "query (radius_rule='gather')", sources), rule)
    if rule == "scatter":
        return Radii(_check_radii_of("cutoff", cutoff, n, "position (radius_rule='scatter')", sources), None, rule)
    if not isinstance(cutoff, tuple) or len(cutoff) != 2:
        raise ValueError(
            f"cutoff must be a pair of arrays, of the positions [{n}] and of the queries [{m}], where radius_rule="
            f"{SUM if summed else rule!r} asks for both, got {_describe_array(cutoff)}."
        )
    of_sources = _check_radii_of("cutoff[0]", cutoff[0], n, "position", sources, summed)
    return Radii(of_sources, _check_radii_of("cutoff[1]", cutoff[1], m, "query", sources, summed), rule, summed)


def _check_radii_of(name: str, radii: Given, size: int, what: str, like: Array, doubled: bool = False) -> Array:
    radii = as_array(name, radii, np.dtype(like.dtype))
    if not hasattr(radii, "dtype") or not np.issubdtype(radii.dtype, np.floating):
        raise TypeError(f"{name} must be a number, or an array of floats with one per {what}, got {_describe_array(radii)}.")
    if tuple(radii.shape) != (size,):
        raise ValueError(f"{name} must be a number, or have shape [{size}], one per {what}, got shape {list(radii.shape)}.")
    if doubled and not isinstance(radii, Tracer):
        with np.errstate(over="ignore"):  # a status bit tells of cutoffs that are not finite
            return make_on_host(radii, lambda known: 2 * known.astype(like.dtype))
    radii = as_dtype(radii, like.dtype)
    return 2 * radii if doubled else radii


def check_species(cutoff: Given, species: Given, rule: object, sources: Array, queries: Array | None, masked: bool) -> Radii:
    """Return cutoffs of pairs of species, [s, s]; `masked` says that some particles may be inactive, and have any species."""
    if rule != RULES[0]:
        raise ValueError(f"radius_rule is about cutoffs per particle, not of pairs of species: leave it out, got {rule!r}.")
    n, m = sources.shape[0], None if queries is None else queries.shape[0]
    if m is None:
        of_sources = of_queries = _check_numbers("species", "species", species, n, "particle")[0]
    elif isinstance(species, tuple) and len(species) == 2:
        of_sources = _check_numbers("species[0]", "species", species[0], n, "position")[0]
        of_queries = _check_numbers("species[1]", "species", species[1], m, "query")[0]
    else:
        raise ValueError(
            f"species must be a pair of arrays, of the positions [{n}] and of the queries [{m}], got {_describe_array(species)}."
        )
    table = check_table(cutoff, sources)
    for name, given in (("species", of_sources), ("species[1]", of_queries)):
        if masked or isinstance(given, Tracer):  # a status bit tells of species that are not in the table
            continue
        known: Any = np.asarray(jax.device_get(given))
        wrong = known[(known < 0) | (known >= len(table))]
        if wrong.size:
            raise ValueError(f"{name} must be numbers of species from 0 to {len(table) - 1}, the rows of cutoff, got {wrong[0]}.")
    return Radii(of_sources, of_queries, TABLE, table=table, alike=_reach_alike(table))


def _reach_alike(table: Array) -> bool:
    """Say whether cutoffs of pairs of species are known, and no species reaches more than `ALIKE` times as far as another."""
    if isinstance(table, Tracer):
        return False
    farthest = np.asarray(jax.device_get(table)).max(axis=1)
    return bool(ALIKE * farthest.min() >= farthest.max())


def check_table(cutoff: Given, like: Array, kinds: int | None = None) -> Array:
    """Return cutoffs of pairs of species, [s, s], in the dtype of the positions; `kinds` is s, where it is known."""
    cutoff = as_array("cutoff", cutoff, np.dtype(like.dtype))
    if not hasattr(cutoff, "dtype") or not np.issubdtype(cutoff.dtype, np.floating) or len(cutoff.shape) != 2:
        raise TypeError(
            "cutoff must be an array of floats of shape [s, s], the cutoffs of pairs of s species, where species is given, got "
            f"{_describe_array(cutoff)}."
        )
    if cutoff.shape[0] != cutoff.shape[1] or cutoff.shape[0] == 0 or cutoff.shape[0] != (kinds or cutoff.shape[0]):
        size = kinds or "s"
        raise ValueError(
            f"cutoff must have shape [{size}, {size}], a row and a column for each species, got shape {list(cutoff.shape)}."
        )
    if cutoff.shape[0] > _MOST_KINDS:
        raise ValueError(f"cutoff holds cutoffs of {cutoff.shape[0]} species: at most {_MOST_KINDS}.")
    table = as_dtype(cutoff, like.dtype)
    if isinstance(table, Tracer):
        return table
    known: Any = np.asarray(jax.device_get(table))
    wrong = np.argwhere(~is_radius(known) | (known != known.T))
    if len(wrong):
        a, b = wrong[0].tolist()
        raise ValueError(
            "cutoff must be symmetric, and hold cutoffs that are positive and finite, or 0 for species that are no neighbors, "
            f"got {known[a, b]} for species {a} and {b}, and {known[b, a]} for {b} and {a}."
        )
    return table


def largest_known(radii: Radii) -> float | None:
    """Return the largest valid cutoff, or 1 if none is valid; None if cutoffs are traced."""
    given = [x for x in (radii.sources, radii.queries) if x is not None] if radii.table is None else [radii.table.reshape(-1)]
    if any(isinstance(x, Tracer) for x in given):
        return None
    values: Any = np.concatenate(jax.device_get(given))
    low, high = RANGE_OF[values.dtype]
    return float(np.max(values[(values >= low) & (values <= high)], initial=0)) or 1.0


def check_skin(skin: object, cutoff: float, dtype: np.dtype) -> float:
    """Return a static skin, rounded to the dtype of the positions; 0 means no skin."""
    if isinstance(skin, Tracer | bool) or not isinstance(skin, Real):
        raise TypeError(f"skin must be a number known while tracing, got {_describe(skin)}.")
    value, (least, most) = float(dtype.type(skin)), RANGE_OF[dtype]
    low, high = 2 * least, most - cutoff
    if not (value == 0 or low <= value <= high):
        raise ValueError(
            f"skin={float(skin)} must be 0 (no skin) or between {low:.1e} and {high:.1e}, so that {dtype} can tell whether a "
            "particle moved half of it: choose e.g. a tenth to a third of the cutoff."
        )
    return value


def check_active(active: Given, positions: Array) -> Array:
    """Return the mask of active particles, [n] bool."""
    active = as_array("active", active, empty=bool)
    if not hasattr(active, "dtype") or np.dtype(active.dtype) != np.bool_:
        raise TypeError(f"active must be an array of bool, one per particle, got {_describe_array(active)}.")
    if tuple(active.shape) != positions.shape[:1]:
        raise ValueError(f"active must have shape [{positions.shape[0]}], one bool per particle, got shape {list(active.shape)}.")
    return on_device(active)


def check_batch(batch: Given, sources: Array, queries: Array | None) -> Batch:
    """Return the system numbers of the particles, and of separate queries, as int32."""
    if queries is None:
        of_sources, fit = _check_numbers("batch", "system", batch, sources.shape[0], "particle")
        return Batch(of_sources, None, None if fit is None else (fit, None))
    if not isinstance(batch, tuple) or len(batch) != 2:
        raise ValueError(
            f"batch must be a pair of arrays, of the positions [{sources.shape[0]}] and of the queries [{queries.shape[0]}], got "
            f"{_describe_array(batch)}."
        )
    of_sources, fit = _check_numbers("batch[0]", "system", batch[0], sources.shape[0], "position")
    of_queries, also = _check_numbers("batch[1]", "system", batch[1], queries.shape[0], "query")
    if fit is None and also is None:
        return Batch(of_sources, of_queries)
    known = (jnp.ones(x.shape, bool) if each is None else each for x, each in ((of_sources, fit), (of_queries, also)))
    return Batch(of_sources, of_queries, (next(known), next(known)))


def _check_numbers(name: str, of: str, systems: Given, size: int, what: str) -> tuple[Array, Array | None]:
    """Return the number of the system, or of the species, of each particle as int32, and which of them fit; None: all do.

    Traced integers that are wider are taken; the largest int32 stands for those that do not fit.
    """
    systems = as_array(name, systems, empty=int)
    if not hasattr(systems, "dtype") or not np.issubdtype(systems.dtype, np.integer):
        raise TypeError(f"{name} must be an array of integers, the {of} of each {what}, got {_describe_array(systems)}.")
    if tuple(systems.shape) != (size,):
        raise ValueError(f"{name} must have shape [{size}], the {of} of each {what}, got shape {list(systems.shape)}.")
    if np.can_cast(systems.dtype, np.int32):
        return as_dtype(systems, np.dtype(np.int32)), None
    most = np.iinfo(np.int32).max
    if isinstance(systems, Tracer):
        systems = gather(systems)
        fit = systems <= most
        fit = fit if np.issubdtype(systems.dtype, np.unsignedinteger) else fit & (systems >= -most - 1)
        return jnp.where(fit, systems, most).astype(np.int32), fit
    values: Any = np.asarray(jax.device_get(systems))
    if values.size and not -(2**31) <= int(values.min()) <= int(values.max()) < 2**31:
        raise ValueError(f"{name} holds numbers from {values.min()} to {values.max()}, but they are numbered in int32.")
    return make_on_host(systems, lambda known: known.astype(np.int32)), None


def check_box(box: object, positions: Array, like: Box | None = None) -> Box | None:
    """Return a box, with `like` of the same kind, or None if no axis is periodic and positions are lengths."""
    if not isinstance(box, Box):
        raise TypeError(f"box must be a jfrnn.Box, got {_describe(box)}: write e.g. jfrnn.Box([1.0, 1.0, 1.0]).")
    if box.dim != positions.shape[1]:
        raise ValueError(
            f"box has {box.dim} axes, but positions have {positions.shape[1]} columns: give as many lengths or lattice vectors."
        )
    if like is not None and _kind_of(box) != _kind_of(like):
        was, came = (_kind_of(b) for b in (like, box))
        raise ValueError(f"box must be of the kind with which the list was made ({was}), got {came}.")
    check_box_range(box, positions.dtype)
    return box if any(box.periodic) or box.fractional or box.per_system else None


def _kind_of(box: Box) -> str:
    known = f"periodic={box.periodic}" if box.flags is None else "periodic per system"
    many = f", for each of {box.vectors.shape[0]} systems" if box.per_system else ""
    return f"{known}, {'lengths' if box.orthogonal else 'matrix'}{', fractional' * box.fractional}{many}"


def check_values(name: str, values: Tree, size: int, what: str, more: str = "") -> Tree:
    """Return a pytree of arrays with so many rows each; a TypeError or ValueError names the one that is none, and says `more`."""

    def check(path: KeyPath, leaf: Given) -> Given:
        full = f"{name}{jax.tree_util.keystr(path)}"
        leaf = as_array(full, leaf)
        if not hasattr(leaf, "shape") or not hasattr(leaf, "dtype"):
            raise TypeError(f"{full} must be an array with a row per {what}, got {type(leaf).__name__}.")
        if tuple(leaf.shape[:1]) != (size,):
            raise ValueError(f"{full} must have shape [{size}, ...], one row per {what}, got {list(leaf.shape)}{more}.")
        if isinstance(leaf, np.ndarray):
            try:
                jax.typeof(leaf)
            except TypeError:
                raise TypeError(
                    f"{full} must hold numbers of a dtype that JAX has, got {leaf.dtype}: convert them, e.g. .astype(np.float32)."
                ) from None
            refuse_wrapping(full, leaf)
        return leaf

    return jax.tree_util.tree_map_with_path(check, values)


def check_flag(name: str, value: object) -> bool:
    """Return a static bool."""
    if isinstance(value, bool | np.bool_):
        return bool(value)
    raise TypeError(f"{name} must be True or False, known while tracing, got {_describe(value)}.")


def check_capacity(capacity: object) -> int:
    """Return a static capacity of at least one slot per row."""
    if isinstance(capacity, bool) or not isinstance(capacity, int | np.integer):
        raise TypeError(
            f"capacity must be a static int (slots per row), known while tracing, got {_describe(capacity)}: pass a Python int, "
            "e.g. nbrs.capacity of an earlier search."
        )
    if capacity < 1:
        raise ValueError(f"capacity must be at least 1, got {capacity}.")
    if capacity > _MOST_SLOTS_OF_ROW:
        raise ValueError(
            f"capacity must be at most {_MOST_SLOTS_OF_ROW}, as many as int32 numbers in a row, got {capacity}: pass less, "
            "or a smaller slack."
        )
    return int(capacity)


def check_slack(slack: object) -> float:
    """Return a static factor of at least 1."""
    if isinstance(slack, bool) or not isinstance(slack, Real):
        raise TypeError(f"slack must be a number of at least 1, known while tracing, got {_describe(slack)}.")
    if not (math.isfinite(slack) and slack >= 1):
        raise ValueError(f"slack must be finite and at least 1 (the capacity is slack times the longest row), got {slack}.")
    return float(slack)


def check_size(name: str, size: object) -> int:
    """Return the number of points of a planned search."""
    if isinstance(size, bool) or not isinstance(size, int | np.integer):
        raise TypeError(f"{name} must be an int, the number of points, got {_describe(size)}.")
    if not 0 <= size <= _MOST_POINTS:
        raise ValueError(f"{name} must be a number of points from 0 to {_MOST_POINTS}, got {size}.")
    return int(size)


def check_kind(dim: object, dtype: Given) -> tuple[int, np.dtype]:
    """Return the dimension and dtype of the positions of a planned search."""
    if isinstance(dim, bool) or not isinstance(dim, int | np.integer) or dim not in (2, 3):
        raise ValueError(f"dim must be 2 or 3, got {_describe(dim)}.")
    try:
        known = np.dtype(dtype)
    except TypeError:
        known = None
    if known not in (np.float32, np.float64):
        raise TypeError(f"dtype must be float32 or float64, got {_describe(dtype) if known is None else known}.")
    if known == np.float64 and not jax.config.read("jax_enable_x64"):
        raise TypeError(
            "dtype is float64, but JAX's 64-bit mode is off, so that no search can have such positions: call "
            'jax.config.update("jax_enable_x64", True) at start-up, or pass dtype=np.float32.'
        )
    return int(dim), known


def _describe(value: object) -> str:
    if isinstance(value, Tracer):
        return f"a traced value {value}"
    if getattr(value, "ndim", 0) > 0:
        return _describe_array(value)
    text = f"{value!r}"
    return f"{type(value).__name__} {text if len(text) <= 100 else f'{text[:97]}...'}"


def _describe_array(value: Given) -> str:
    return f"{np.dtype(value.dtype)} of shape {list(np.shape(value))}" if hasattr(value, "dtype") else _describe(value)
