"""Hard cases decided on the device, against the oracle of the tests."""

import functools
import importlib
import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import jfrnn
from experiments.gpu import sums, triangles
from experiments.gpu.config import Exactness

RULES = ("gather", "scatter", "either", "both", "mean")
_ABOUT = {"hard": "", "periodic": ", boxes", "radii": ", a cutoff per particle"}
Decisions = Iterator[tuple[str, bool]]


class Case(NamedTuple):
    """A search, and the pairs that it has to find: (i, j, image), sorted; rows are filled up with points that are nowhere."""

    name: str
    positions: np.ndarray
    cutoff: Any
    options: dict[str, Any]
    expected: list[tuple[int, int, tuple[int, ...]]]
    rows: int


def rows(config: Exactness, dtype: str, dim: int) -> Iterator[dict[str, Any]]:
    """Decide every case of a table; yield one row, which says how many are wrong, and which."""
    if config.cases == "triangles":
        found = triangles.decisions(oracle(), dtype, dim, config.capacity, config.backend)
    elif config.cases == "sums":
        found = sums.decisions(dtype, dim, config.capacity, config.backend, config.least_rows)
    else:
        found = _decisions(config, dtype, dim)
    right = dict(found)
    wrong = [name for name, is_right in right.items() if not is_right]
    method = f"jfrnn {config.backend}{_ABOUT.get(config.cases, f', {config.cases}')}"
    about = {"kind": "exactness", "method": method, "dtype": dtype, "dim": dim, "least_rows": config.least_rows}
    yield about | {"cases": len(right), "wrong": len(wrong), "wrong_cases": wrong}


def oracle() -> Any:  # noqa: ANN401
    """Return the oracle of the tests."""
    return importlib.import_module("tests.reference")


def _decisions(config: Exactness, dtype: str, dim: int) -> Decisions:
    cases = {"hard": _hard, "periodic": _periodic, "radii": _radii, "batches": _batches}[config.cases]
    for case in cases(dtype, dim):
        rows = max(case.rows, config.least_rows)
        given = dict(case.options)
        for name in ("queries", "batch", "cutoff"):
            given[name] = _pad_rows(given.get(name, case.cutoff if name == "cutoff" else None), rows)
        options: dict[str, Any] = {name: value for name, value in given.items() if value is not None} | {"backend": config.backend}
        x = jnp.asarray(sums.pad_points(case.positions, rows))
        nbrs = jfrnn.search(x, **options, capacity=config.capacity)
        yield case.name, found_pairs(nbrs, x, options.get("queries")) == case.expected


def _pad_rows(value: Any, rows: int) -> Any:  # noqa: ANN401
    """Fill up what has a value per row: queries, cutoffs and numbers of systems, which matter to no point that is nowhere."""
    if isinstance(value, tuple):
        return tuple(_pad_rows(part, rows) for part in value)
    if not isinstance(value, np.ndarray):
        return value
    if value.ndim == 2:
        return jnp.asarray(sums.pad_points(value, rows))
    return np.concatenate([value, np.ones(rows - len(value), value.dtype) * (value.dtype.kind == "f")]).astype(value.dtype)


def found_pairs(nbrs: Any, x: Any, queries: Any) -> list[tuple[int, int, tuple[int, ...]]] | None:  # noqa: ANN401
    """Return (i, j, image) of every slot in use, sorted; None where a slot that is not in use does not say so."""
    idx, count = np.asarray(nbrs.idx), np.asarray(nbrs.count)
    used = np.arange(nbrs.capacity) < count[:, None]
    if (idx[~used] != nbrs.source_count).any() or (idx[used] >= nbrs.source_count).any() or (idx < 0).any():
        return None
    i, k = np.nonzero(used)
    images = np.zeros((len(i), x.shape[1]), int)
    if nbrs.box is not None:
        images = np.asarray(nbrs.shifts(x, queries=queries))[i, k]
    return sorted(zip(i.tolist(), idx[i, k].tolist(), map(tuple, images.tolist()), strict=True))


def _hard(dtype: str, dim: int) -> Iterator[Case]:
    from jfrnn.cases.hard import HARD_CASES

    for name, closed in itertools.product(HARD_CASES, (False, True)):
        if name == "denormal_lattice":  # a denormal cutoff is refused
            continue
        given = HARD_CASES[name].build(dtype, dim)
        most = max(len(given.positions), 0 if given.queries is None else len(given.queries))
        options = {"queries": given.queries, "closed": closed}
        expected = _plain_pairs(name, dtype, dim, closed)
        yield Case(f"{name}{'-closed' * closed}", given.positions, given.cutoff, options, expected, 704 if most <= 704 else 2048)


@functools.lru_cache(maxsize=1024)
def _plain_pairs(name: str, dtype: str, dim: int, closed: bool) -> list[tuple[int, int, tuple[int, ...]]]:
    from jfrnn.cases.hard import HARD_CASES

    given = HARD_CASES[name].build(dtype, dim)
    pairs = oracle().reference_pairs(given.positions, given.cutoff, queries=given.queries, closed=closed)
    return sorted((i, j, (0,) * dim) for i, j in pairs)


def _periodic(dtype: str, dim: int) -> Iterator[Case]:
    from jfrnn.cases.periodic import PERIODIC_CASES

    for name, half in itertools.product(PERIODIC_CASES, (False, True)):
        given = PERIODIC_CASES[name].build(dtype, dim)
        if not any(given.periodic) or (half and given.queries is not None):
            continue
        about = {"matrix": given.matrix, "periodic": given.periodic, "queries": given.queries, "half": half}
        expected = sorted(oracle().reference_images(given.positions, given.cutoff, **about))
        options = {"queries": given.queries, "half": half, "box": jfrnn.Box(given.matrix, given.periodic)}
        yield Case(f"{name}{'-half' * half}", given.positions, given.cutoff, options, expected, 304)


def _radii(dtype: str, dim: int) -> Iterator[Case]:
    from jfrnn.cases.radii import RADII_CASES

    for name, rule in itertools.product(RADII_CASES, RULES):
        given = RADII_CASES[name].build(dtype, dim)
        cutoff: Any = given.cutoffs
        if given.queries is not None:
            cutoff = {"gather": given.query_cutoffs, "scatter": cutoff}.get(rule, (cutoff, given.query_cutoffs))
        about = {"queries": given.queries, "query_radii": given.query_cutoffs, "lengths": given.lengths}
        expected = sorted(oracle().reference_radii(given.positions, given.cutoffs, rule, **about))
        box = None if given.lengths is None else jfrnn.Box(given.lengths)
        yield Case(
            f"{name}-{rule}", given.positions, cutoff, {"queries": given.queries, "box": box, "radius_rule": rule}, expected, 128
        )


def _batches(dtype: str, dim: int) -> Iterator[Case]:
    from jfrnn.cases.batches import BATCH_CASES

    for name, closed in itertools.product(BATCH_CASES, (False, True)):
        given = BATCH_CASES[name].build(dtype, dim)
        of_queries, batch = given.batch, given.batch
        if given.query_batch is not None:
            of_queries, batch = given.query_batch, (given.batch, given.query_batch)
        matrix = np.ones(dim) if given.lengths is None else given.lengths
        about = {"matrix": matrix, "periodic": (given.lengths is not None,) * dim, "queries": given.queries, "closed": closed}
        pairs = oracle().reference_images(given.positions, given.cutoff, **about)
        expected = sorted(pair for pair in pairs if of_queries[pair[0]] == given.batch[pair[1]])
        box = None if given.lengths is None else jfrnn.Box(given.lengths)
        options = {"queries": given.queries, "box": box, "closed": closed, "batch": batch}
        yield Case(f"{name}{'-closed' * closed}", given.positions, given.cutoff, options, expected, 128)
