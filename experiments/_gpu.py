"""One run on a GPU: every hard case against the oracle first, then all timings, rows written one at a time.

A time counts only where its pairs were checked: lists are compared as sets with the array engine, whose decisions are its own.
"""

import functools
import importlib
import itertools
import json
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, NonNegativeInt, PositiveInt
from tqdm import tqdm

from experiments import _compare, _config, _gpu_sums, _gpu_triangles, _machine, _measure, _ways
from experiments._config import Positive, Table
from jfrnn._engine.warp import kernels_of, load_warp
from jfrnn._search.neighbor_list import rounded_capacity


class Exactness(Table):
    """Which hard cases are decided on the device."""

    backend: Literal["jax", "warp", "hashgrid", "brute", "bvh"]
    dtypes: list[Literal["float32", "float64"]]
    dims: list[Literal[2, 3]]
    capacity: PositiveInt
    # which table of jfrnn.cases, or "sums" of whole numbers against lists
    cases: Literal["hard", "periodic", "radii", "batches", "triangles", "sums"] = "hard"


class Triangles(Table):
    """Which lists of triangles around a gear are timed: every combination."""

    points: list[PositiveInt]
    faces: PositiveInt  # about
    cutoffs: list[Positive]  # in modules
    dtypes: list[Literal["float32", "float64"]]


class Config(Table):
    """What is run, see experiments/configs/h200.toml."""

    seed: int
    reach_in_spacings: Positive
    jitter_in_spacings: Positive
    sizes: list[PositiveInt]
    corners_fill: Positive | None = None  # none: no scene of corners
    counts_only: list[PositiveInt]
    studied_size: PositiveInt | None = None  # none: choices are not studied
    calls: PositiveInt
    steps: PositiveInt
    sums: tuple[Annotated[str, AfterValidator(_ways.known)], ...] = ()  # of a density and its gradient
    repeats: PositiveInt
    seconds_per_timing: Positive
    exactness: list[Exactness]
    warps: NonNegativeInt | None = None  # among which `warp` shares few queries; 0: 32 to a warp, as where they are many
    triangles: tuple[Triangles, ...] = ()


def load(path: Path) -> Config:
    """Read a config; raise UsageError that names what is wrong."""
    return _config.load(path, Config)


def run(config: Config, folder: Path) -> int:
    """Run everything and return the number of wrong hard cases; rows go to rows.jsonl."""
    # one pool from the start: a pool that grows hands out whole pieces, up to 128 MiB larger than what was asked for
    os.environ["XLA_PYTHON_CLIENT_PREALLOCATE"] = "true"
    import jax

    jax.config.update("jax_enable_x64", True)
    folder.mkdir(parents=True, exist_ok=True)
    device = jax.devices()[0]
    about = {"device": device.device_kind, "versions": _machine.versions() | {"warp-lang": load_warp().__version__}}
    about |= _machine.commit()
    if config.warps is not None:
        kernels_of("cells_cuda").GRID["WARPS"] = config.warps  # of kernels that are still to be made
        about["warps"] = config.warps
    wrong = 0
    with (folder / "rows.jsonl").open("a", encoding="utf-8") as file:
        for row in tqdm(_rows(config), desc="rows"):
            wrong += int(row.get("wrong", 0) or 0)
            file.write(json.dumps({**row, **about, "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())}) + "\n")
            file.flush()
    return wrong


def _rows(config: Config) -> Iterator[dict[str, Any]]:
    yield from _memory_rows()
    for part in config.exactness:
        yield from _exactness_rows(part)
    yield _bandwidth_row(config)
    if config.corners_fill is not None:
        yield from _scene_rows(config, "corners", _corners(config, config.corners_fill))
    for n in config.sizes:
        yield from _scene_rows(config, "jitter", _jitter_lattice(config, n))
    if config.studied_size is not None:
        yield from _study_rows(config, config.studied_size)
    for n in config.counts_only:
        yield _count_row(config, n)
        if config.sums:
            yield from _large_sum_rows(config, n)
    for part in config.triangles:
        for n, cutoff, dtype in itertools.product(part.points, part.cutoffs, part.dtypes):
            timed = functools.partial(_timed, config)
            yield from _gpu_triangles.rows(n, part.faces, cutoff, dtype, config.steps, timed)


# --- scenes -----------------------------------------------------------------------------------------------------------


def _jitter_lattice(config: Config, n: int) -> np.ndarray:
    """Return a cubic lattice of spacing 1, every point moved at random, in random order: float32 [about n, 3]."""
    random = np.random.default_rng(config.seed)
    side = round(n ** (1 / 3))
    sites = np.stack(np.meshgrid(*[np.arange(side, dtype=np.float32)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    sites += random.uniform(-config.jitter_in_spacings, config.jitter_in_spacings, sites.shape).astype(np.float32)
    random.shuffle(sites)
    return sites


def _corners(config: Config, fill: float) -> np.ndarray:
    from jfrnn.cases import scene  # pyright: ignore[reportMissingImports]

    random = np.random.default_rng(config.seed)
    given = scene("corners", fill=fill)
    moved = given.positions / given.spacing + random.uniform(
        -config.jitter_in_spacings, config.jitter_in_spacings, given.positions.shape
    )
    return random.permutation(moved).astype(np.float32)


# --- exactness --------------------------------------------------------------------------------------------------------


def _exactness_rows(config: Exactness) -> Iterator[dict[str, Any]]:
    decide = {"hard": _hard_decisions, "periodic": _periodic_decisions, "radii": _radii_decisions, "batches": _batch_decisions}
    decide |= {"triangles": _triangle_decisions, "sums": _sum_decisions}
    about = {
        "hard": "",
        "periodic": ", boxes",
        "radii": ", a cutoff per particle",
        "batches": ", batches",
        "triangles": ", triangles",
        "sums": ", sums",
    }
    for dtype, dim in itertools.product(config.dtypes, config.dims):
        right = dict(decide[config.cases](config, dtype, dim))
        wrong = [name for name, is_right in right.items() if not is_right]
        yield {
            "kind": "exactness", "method": f"jfrnn {config.backend}{about[config.cases]}", "dtype": dtype, "dim": dim,
            "cases": len(right), "wrong": len(wrong), "wrong_cases": wrong,
        }  # fmt: skip


def _hard_decisions(config: Exactness, dtype: str, dim: int) -> Iterator[tuple[str, bool]]:
    import jax
    from jfrnn.cases.hard import HARD_CASES  # pyright: ignore[reportMissingImports]

    import jfrnn

    oracle = _oracle()
    for name, closed in itertools.product(HARD_CASES, (False, True)):
        if name == "denormal_lattice":  # a denormal cutoff is refused
            continue
        given = HARD_CASES[name].build(dtype, dim)
        most = max(len(given.positions), 0 if given.queries is None else len(given.queries))
        rows = 704 if most <= 704 else 2048  # shapes shared by many cases: few programs
        queries = None if given.queries is None else _padded(given.queries, rows)
        options = {"queries": queries, "capacity": config.capacity, "closed": closed, "backend": config.backend}
        nbrs = jfrnn.search(jax.numpy.asarray(_padded(given.positions, rows)), given.cutoff, **options)
        yield (
            f"{name}{'-closed' * closed}",
            _compare.is_exact(oracle, nbrs.idx, nbrs.count, nbrs.source_count, _expected(oracle, name, dtype, dim, closed)),
        )


def _periodic_decisions(config: Exactness, dtype: str, dim: int) -> Iterator[tuple[str, bool]]:
    import jax
    from jfrnn.cases.periodic import PERIODIC_CASES  # pyright: ignore[reportMissingImports]

    import jfrnn

    for name, half in itertools.product(PERIODIC_CASES, (False, True)):
        given = PERIODIC_CASES[name].build(dtype, dim)
        if not any(given.periodic) or (half and given.queries is not None):
            continue
        queries = None if given.queries is None else jax.numpy.asarray(_padded(given.queries, 304))
        x, box = jax.numpy.asarray(_padded(given.positions, 304)), jfrnn.Box(given.matrix, given.periodic)
        options = {"queries": queries, "half": half, "capacity": config.capacity, "backend": config.backend}
        nbrs = jfrnn.search(x, given.cutoff, box=box, **options)
        about = {"matrix": given.matrix, "periodic": given.periodic, "queries": given.queries, "half": half}
        expected = _oracle().reference_images(given.positions, given.cutoff, **about)
        yield f"{name}{'-half' * half}", _images(nbrs, x, queries) == sorted(expected)


def _radii_decisions(config: Exactness, dtype: str, dim: int) -> Iterator[tuple[str, bool]]:
    import jax.numpy as jnp
    from jfrnn.cases.radii import RADII_CASES  # pyright: ignore[reportMissingImports]

    import jfrnn
    from jfrnn._geometry.exact import RULES

    def padded(radii: np.ndarray) -> np.ndarray:
        return np.concatenate([radii, np.ones(128 - len(radii), radii.dtype)])

    for name, rule in itertools.product(RADII_CASES, RULES):
        given = RADII_CASES[name].build(dtype, dim)
        x, box = jnp.asarray(_padded(given.positions, 128)), None if given.lengths is None else jfrnn.Box(given.lengths)
        cutoff: Any = padded(given.cutoffs)
        queries = None
        if given.queries is not None:
            own, queries = padded(given.query_cutoffs), jnp.asarray(_padded(given.queries, 128))
            cutoff = {"gather": own, "scatter": cutoff}.get(rule, (cutoff, own))
        options = {"queries": queries, "box": box, "radius_rule": rule, "capacity": config.capacity, "backend": config.backend}
        nbrs = jfrnn.search(x, cutoff, **options)
        about = {"queries": given.queries, "query_radii": given.query_cutoffs, "lengths": given.lengths}
        expected = _oracle().reference_radii(given.positions, given.cutoffs, rule, **about)
        yield f"{name}-{rule}", _images(nbrs, x, queries) == sorted(expected)


def _batch_decisions(config: Exactness, dtype: str, dim: int) -> Iterator[tuple[str, bool]]:
    import jax.numpy as jnp
    from jfrnn.cases.batches import BATCH_CASES  # pyright: ignore[reportMissingImports]

    import jfrnn

    def padded(systems: np.ndarray) -> np.ndarray:
        return np.concatenate([systems, np.zeros(128 - len(systems), np.int32)])

    for name, closed in itertools.product(BATCH_CASES, (False, True)):
        given = BATCH_CASES[name].build(dtype, dim)
        x, box = jnp.asarray(_padded(given.positions, 128)), None if given.lengths is None else jfrnn.Box(given.lengths)
        of_queries, queries = given.batch, None
        batch: Any = padded(given.batch)
        if given.queries is not None:
            of_queries, queries = given.query_batch, jnp.asarray(_padded(given.queries, 128))
            batch = (batch, padded(given.query_batch))
        options = {"queries": queries, "box": box, "closed": closed, "capacity": config.capacity, "backend": config.backend}
        nbrs = jfrnn.search(x, given.cutoff, batch=batch, **options)
        matrix = np.ones(dim) if given.lengths is None else given.lengths
        about = {"matrix": matrix, "periodic": (given.lengths is not None,) * dim, "queries": given.queries, "closed": closed}
        pairs = _oracle().reference_images(given.positions, given.cutoff, **about)
        expected = sorted(pair for pair in pairs if of_queries[pair[0]] == given.batch[pair[1]])
        yield f"{name}{'-closed' * closed}", _images(nbrs, x, queries) == expected


def _triangle_decisions(config: Exactness, dtype: str, dim: int) -> Iterator[tuple[str, bool]]:
    return _gpu_triangles.decisions(_oracle(), dtype, dim, config.capacity, config.backend)


def _sum_decisions(config: Exactness, dtype: str, dim: int) -> Iterator[tuple[str, bool]]:
    return _gpu_sums.decisions(dtype, dim, config.capacity, config.backend)


def _oracle() -> Any:  # noqa: ANN401
    return importlib.import_module("tests.reference")


def _images(nbrs: Any, x: Any, queries: Any) -> list[tuple[int, int, tuple[int, ...]]]:  # noqa: ANN401
    """Return (i, j, S) of every slot, sorted, on the host: a program for each kind of box would take long to compile."""
    from jfrnn._geometry.box import unpacked_turns

    idx, count = np.asarray(nbrs.idx), np.asarray(nbrs.count)
    i, k = np.nonzero(np.arange(nbrs.capacity) < count[:, None])
    j, kind = idx[i, k], nbrs.box_kind
    if (j >= nbrs.source_count).any() or (j < 0).any():
        return []
    if kind is None:
        shifts = np.zeros((len(i), x.shape[1]), int)
    elif nbrs.images is None:
        sources = np.asarray(x, np.float64)
        points = sources if queries is None else np.asarray(queries, np.float64)
        periodic, vectors = list(kind.periodic), np.asarray(nbrs.box.vectors, np.float64)
        vectors = (np.diag(vectors) if vectors.ndim == 1 else vectors)[periodic]
        shifts = np.zeros((len(i), sources.shape[1]), int)
        shifts[:, periodic] = -np.rint((sources[j] - points[i]) @ np.linalg.pinv(vectors))
    else:
        codes, source_turns, query_turns = nbrs.images
        turns = np.asarray(unpacked_turns(source_turns, nbrs.box.dim))
        own_turns = turns if query_turns is None else np.asarray(unpacked_turns(query_turns, nbrs.box.dim))
        shifts = (kind.shifts[np.asarray(codes)[i, k]] + own_turns[i] - turns[j]) @ kind.numbers
        if nbrs.half and kind.basis is not None:  # of an image of its own, a particle keeps the one ahead in the given vectors
            leads = np.take_along_axis(shifts, np.argmax(shifts != 0, axis=1)[:, None], axis=1)
            shifts = np.where((i == j)[:, None] & (leads < 0), -shifts, shifts)
    return sorted(zip(i.tolist(), j.tolist(), map(tuple, shifts.tolist()), strict=True))


@functools.lru_cache(maxsize=1024)
def _expected(oracle: Any, name: str, dtype: str, dim: int, closed: bool) -> Any:  # noqa: ANN401
    from jfrnn.cases.hard import HARD_CASES  # pyright: ignore[reportMissingImports]

    given = HARD_CASES[name].build(dtype, dim)
    return oracle.reference_pairs(given.positions, given.cutoff, queries=given.queries, closed=closed)


def _padded(points: np.ndarray, rows: int) -> np.ndarray:
    return np.concatenate([points, np.full((rows - len(points), points.shape[1]), np.nan, points.dtype)])


# --- memory -----------------------------------------------------------------------------------------------------------


def _memory_rows() -> Iterator[dict[str, Any]]:
    """Compare `memory_plan` with the peak of JAX's allocator and of Warp's pool; first of all, since peaks only rise."""
    import jax

    import jfrnn

    random = np.random.default_rng(0)
    blob = random.uniform(0, 8, (50_000, 3))
    scenes = {f"two blobs, {gap:.0e} cutoffs apart": np.concatenate([blob, blob + np.array([gap, 0, 0])]) for gap in (10.0, 1e6)}
    scenes["uniform"] = random.uniform(0, 60, (1_000_000, 3))
    jax.block_until_ready(jfrnn.search(jax.numpy.asarray(blob[:1000], jax.numpy.float32), 1.0, backend="warp").idx)  # libraries
    for name, points in scenes.items():
        x = jax.numpy.asarray(points, jax.numpy.float32)
        capacity = rounded_capacity(int(jfrnn.count(x, 1.0, backend="warp").max()))
        search = jax.jit(functools.partial(_listed, cutoff=1.0, capacity=capacity, backend="warp"))
        compiled: Any = search.lower(x).compile().memory_analysis()
        before = _device_bytes("bytes_in_use")
        jax.block_until_ready(search(x))
        plan = jfrnn.memory_plan(len(points), 1.0, capacity, backend="warp")
        yield {
            "kind": "memory", "method": "warp", "layout": name, "points": len(points), "capacity": capacity,
            "planned_bytes": plan.total_bytes, "planned_scratch_bytes": plan.scratch_bytes,
            "compiled_bytes": compiled.temp_size_in_bytes + compiled.output_size_in_bytes,
            "peak_bytes": _device_bytes("peak_bytes_in_use") - before, "warp_pool_bytes": _warp_pool_bytes(),
        }  # fmt: skip


def _device_bytes(what: str) -> int:
    import jax

    return (jax.devices()[0].memory_stats() or {}).get(what, 0)


def _warp_pool_bytes() -> int:
    wp = load_warp()
    return wp.get_mempool_used_mem_high("cuda:0") if wp.is_cuda_available() else 0


# --- timings ----------------------------------------------------------------------------------------------------------


def _listed(x: Any, *, cutoff: float, capacity: int, backend: str) -> Any:  # noqa: ANN401
    import jfrnn

    nbrs = jfrnn.search(x, cutoff, capacity=capacity, backend=backend)
    return nbrs.idx, nbrs.count


def _timed(config: Config, call: Callable[[], Any], calls: int | None = None) -> dict[str, Any]:
    """Time calls that are not waited for one by one; a repeat ends when the last is done."""
    import jax

    jax.block_until_ready(call())
    start = time.perf_counter()
    jax.block_until_ready(call())
    once = time.perf_counter() - start
    calls = calls or max(1, min(config.calls, int(config.seconds_per_timing / config.repeats / max(once, 1e-9))))
    seconds = []
    for _ in range(config.repeats):
        start = time.perf_counter()
        result = None
        for _ in range(calls):
            result = call()
        jax.block_until_ready(result)
        seconds.append((time.perf_counter() - start) / calls)
    return _measure.summarize(seconds) | {"calls": calls}


def _scene_rows(config: Config, layout: str, points: np.ndarray) -> Iterator[dict[str, Any]]:
    import jax
    import jax.numpy as jnp
    from jax import lax

    import jfrnn

    x, cutoff, n = jnp.asarray(points), config.reach_in_spacings, len(points)
    exact = np.asarray(jfrnn.count(x, cutoff, backend="jax"))
    capacity = rounded_capacity(int(exact.max()))
    base = {"layout": layout, "points": n, "capacity": capacity, "dtype": "float32", "exact_directed_pairs": int(exact.sum())}
    listed = functools.partial(_listed, cutoff=cutoff, capacity=capacity)

    for backend in ("warp", "hashgrid"):
        search = jax.jit(functools.partial(listed, backend=backend))
        idx, count = search(x)
        again = search(x)
        row = {"kind": "call", "method": f"jfrnn {backend}", **base, "directed_pairs": int(np.asarray(count).sum(dtype=np.int64))}
        row["wrong"] = int((np.asarray(count) != exact).sum())
        row["same_bits_twice"] = bool((idx == again[0]).all() and (count == again[1]).all())
        if n <= 1_000_000:
            row["wrong"] += _compare.different_rows(idx, jax.jit(functools.partial(listed, backend="jax"))(x)[0])
        del idx, count, again
        yield row | _timed(config, lambda search=search: search(x))
    counts = jax.jit(lambda x: jfrnn.count(x, cutoff, backend="warp"))
    yield {"kind": "call", "method": "jfrnn warp, counts", **base, "directed_pairs": int(counts(x).sum())} | _timed(
        config, lambda: counts(x)
    )
    if n <= 1_000_000:

        def step(x: Any, _: None) -> tuple[Any, Any]:  # noqa: ANN401
            idx, count = listed(x, backend="warp")
            return x + 0 * (idx[0, 0] + count[0]).astype(x.dtype), None

        steps = jax.jit(lambda x: lax.scan(step, x, None, length=config.steps)[0])
        seconds = [s / config.steps for s in _timed(config, lambda: steps(x), calls=3)["seconds"]]
        yield {"kind": "scan", "method": "jfrnn warp", **base, "steps": config.steps, **_measure.summarize(seconds)}
    if layout == "jitter":
        yield from _loop_rows(config, base, x, cutoff)
        yield from _sum_rows(config, base, x, cutoff)
    yield from _peer_rows(config, base, x, cutoff)


def _loop_rows(config: Config, base: dict[str, Any], x: Any, cutoff: float) -> Iterator[dict[str, Any]]:  # noqa: ANN401
    """What a time loop adds: a periodic box, whose faces close the lattice, and updates of a list with a skin."""
    import jax
    from jax import lax

    import jfrnn

    box = jfrnn.Box([float(round(base["points"] ** (1 / 3)))] * 3, origin=-0.5)
    counts = np.asarray(jfrnn.count(x, cutoff, box=box, backend="warp"))
    capacity = rounded_capacity(int(counts.max()))

    def periodic(x: Any) -> Any:  # noqa: ANN401
        nbrs = jfrnn.search(x, cutoff, box=box, capacity=capacity, backend="warp")
        return nbrs.idx, nbrs.count

    search = jax.jit(periodic)
    row = {"kind": "call", "method": "jfrnn warp, periodic box", **base, "capacity": capacity}
    row |= {"directed_pairs": int(counts.sum(dtype=np.int64)), "exact_directed_pairs": None}
    if base["points"] <= 300_000:
        exact = np.asarray(jfrnn.count(x, cutoff, box=box, backend="jax"))
        row |= {"wrong": int((counts != exact).sum()), "exact_directed_pairs": int(exact.sum(dtype=np.int64))}
    yield row | _timed(config, lambda: search(x))
    if base["points"] > 1_000_000:
        return
    skin = 0.1 * cutoff
    wider = rounded_capacity(int(jfrnn.count(x, cutoff + skin, backend="warp").max()))
    nbrs = jfrnn.search(x, cutoff, skin=skin, capacity=wider, backend="warp")
    for name, velocity in (("keeps", 0.0), ("rebuilds", skin)):

        def step(carry: Any, _: None, velocity: float = velocity) -> tuple[Any, None]:  # noqa: ANN401
            x, nbrs = carry
            x = x + x.dtype.type(velocity)
            return (x, nbrs.update(x)), None

        def many(x: Any, nbrs: Any, step: Any = step) -> Any:  # noqa: ANN401
            return lax.scan(step, (x, nbrs), None, length=config.steps)[0][1].rebuild_count

        steps = jax.jit(many)
        rebuilds = int(steps(x, nbrs))
        seconds = [s / config.steps for s in _timed(config, lambda steps=steps: steps(x, nbrs), calls=3)["seconds"]]
        row = {"kind": "scan", "method": f"jfrnn warp, skin, {name}", **base, "capacity": wider, "steps": config.steps}
        yield row | {"rebuilds": rebuilds, **_measure.summarize(seconds)}


def _sum_rows(config: Config, base: dict[str, Any], x: Any, cutoff: float) -> Iterator[dict[str, Any]]:  # noqa: ANN401
    """A density, and with it its gradient: without a list, and over lists that are made for it."""
    import jax

    masses = np.random.default_rng(config.seed).uniform(0.5, 1.5, base["points"]).astype(np.float32)
    given = _ways.Given(x, jax.numpy.asarray(masses), cutoff)
    for way, gradient in itertools.product(config.sums, (False, True)):
        row: dict[str, Any] = {"kind": "sum", "method": way, "gradient": gradient, **base}
        try:
            steps = _ways.WAYS[way].prepare(given, gradient, False)

            def call(steps: _ways.Steps = steps) -> Any:  # noqa: ANN401
                return steps.sums(given.x, given.m, None if steps.build is None else steps.build(given.x))

            if base["points"] <= 1_000_000:
                row["error"] = _ways.error_of(given, jax.device_get(call()), gradient)
            yield row | _timed(config, call)
        except Exception as error:  # a way that is missing or out of memory says so in its row
            yield row | {"status": "failed", "reason": f"{type(error).__name__}: {error}"[:300]}


def _large_sum_rows(config: Config, n: int) -> Iterator[dict[str, Any]]:
    """The same of so many random particles that a list of them would not fit; what the program takes beside its arguments."""
    import jax

    x, cutoff = _random_points(config, n)
    given = _ways.Given(x, jax.numpy.ones(n, jax.numpy.float32), cutoff)
    for gradient in (False, True):
        sums = _ways.WAYS["pair_sum warp"].prepare(given, gradient, False).sums
        memory: Any = jax.jit(sums).lower(x, given.m, None).compile().memory_analysis()
        row = {"kind": "sum", "method": "pair_sum warp", "gradient": gradient, "layout": "random", "points": n, "dtype": "float32"}
        row |= {"compiled_bytes": memory.temp_size_in_bytes + memory.output_size_in_bytes}
        yield row | _timed(config, lambda sums=sums: sums(x, given.m, None), calls=2)


def _peer_rows(config: Config, base: dict[str, Any], x: Any, cutoff: float) -> Iterator[dict[str, Any]]:  # noqa: ANN401
    for name, make in (("warp HashGrid", _plain_hashgrid), ("nvalchemi 0.5.0 cell_list", _nvalchemi)):
        row: dict[str, Any] = {"kind": "call", "method": name, **base}
        try:
            call, pairs = make(x, cutoff, base["capacity"])
            yield row | {"directed_pairs": pairs} | _timed(config, call)
        except Exception as error:  # a peer that is missing or out of memory says so in its row
            yield row | {"status": "failed", "reason": f"{type(error).__name__}: {error}"[:300]}


def _plain_hashgrid(x: Any, cutoff: float, capacity: int) -> tuple[Callable[[], Any], int]:  # noqa: ANN401
    """Return a call of `wp.HashGrid` as Warp's examples use it, without JAX: build, then one thread per particle."""
    wp = load_warp()
    list_neighbors_kernel = kernels_of("hashgrid_plain").list_neighbors_kernel

    points = wp.array(np.asarray(x), dtype=wp.vec3, device="cuda")
    n = len(points)
    grid = wp.HashGrid(128, 128, 128, device="cuda")
    idx, count = wp.empty((n, capacity), dtype=wp.int32, device="cuda"), wp.empty(n, dtype=wp.int32, device="cuda")

    def call() -> None:
        grid.build(points, cutoff)
        wp.launch(list_neighbors_kernel, dim=n, inputs=[grid.id, points, cutoff, capacity], outputs=[idx, count], device="cuda")

    call()
    return _synchronized(call), int(count.numpy().sum(dtype=np.int64))


class _synchronized:
    """A call whose result `jax.block_until_ready` can wait for: Warp's stream."""

    def __init__(self, call: Callable[[], None]) -> None:
        self._call = call

    def __call__(self) -> "_synchronized":
        self._call()
        return self

    def block_until_ready(self) -> "_synchronized":
        wp = load_warp()
        wp.synchronize()
        return self


def _nvalchemi(x: Any, cutoff: float, capacity: int) -> tuple[Callable[[], Any], int]:  # noqa: ANN401
    import jax
    import jax.numpy as jnp
    from nvalchemiops.jax.neighbors.cell_list import cell_list, estimate_cell_list_sizes  # pyright: ignore

    low = jnp.min(x, axis=0)
    lengths = jnp.max(x, axis=0) - low + 2 * cutoff
    cell, pbc = jnp.diag(lengths)[None], jnp.zeros((1, 3), bool)
    shifted = x - low + cutoff
    cells, _, radius = estimate_cell_list_sizes(shifted, cell, cutoff, pbc)
    search = jax.jit(
        lambda x: cell_list(
            x, cutoff, cell, pbc, max_neighbors=capacity, max_total_cells=int(cells), neighbor_search_radius=radius
        )[:2]
    )
    return (lambda: search(shifted)), int(search(shifted)[1].sum())


def _random_points(config: Config, n: int) -> tuple[Any, float]:
    """Return points made on the device, float32 [n, 3], and a cutoff: about 113 neighbors."""
    import jax

    side = (n / 27.0) ** (1 / 3)  # 27 particles per cube of one cutoff
    return jax.random.uniform(jax.random.key(config.seed), (n, 3), jax.numpy.float32, 0, side), 1.0


def _count_row(config: Config, n: int) -> dict[str, Any]:
    """Count neighbors of so many particles that a list of them would not fit."""
    import jax

    import jfrnn

    x, cutoff = _random_points(config, n)
    counts = jax.jit(lambda x: jfrnn.count(x, cutoff, backend="warp"))
    total = int(np.asarray(counts(x)).sum(dtype=np.int64))
    row = {"kind": "call", "method": "jfrnn warp, counts", "layout": "random", "points": n, "dtype": "float32"}
    row |= {"directed_pairs": total}
    return row | _timed(config, lambda: counts(x), calls=2) | {"peak_bytes": _device_bytes("peak_bytes_in_use")}


# --- what the choices cost: kernels alone, on the device's clock ---------------------------------------------------------


def _study_rows(config: Config, n: int) -> Iterator[dict[str, Any]]:
    wp = load_warp()
    from jfrnn.cases import scene  # pyright: ignore[reportMissingImports]

    if not wp.is_cuda_available():
        return
    jitter = _jitter_lattice(config, n)
    given = scene("full")
    lattice = np.random.default_rng(config.seed).permutation(given.positions).astype(np.float32)
    rounded = float(np.float32(given.cutoff))  # the same number in both precisions: the lattice is full of ties
    for layout, points, cutoff in (("jitter", jitter, config.reach_in_spacings), ("full", lattice, rounded)):
        longest, directed = _kernel_time(config, points, cutoff, 0, lists=False)[2:]
        capacity = rounded_capacity(int(longest))
        for what, options in _STUDIED.items():
            seconds, stages, longest, pairs = _kernel_time(config, points, cutoff, capacity, **options)
            yield {
                "kind": "study", "method": what, "layout": layout, "points": len(points), "capacity": capacity,
                "exact_directed_pairs": directed, "directed_pairs": pairs, "longest": longest, "median_s": seconds, **stages,
            }  # fmt: skip


_STUDIED: dict[str, dict[str, Any]] = {
    "float32, exact, cells of r/6 along x": {},
    "float64, exact": {"double": True},
    "counts alone": {"lists": False},
    "cells of r/4 along x": {"reach_x": 4},
    "cells of r": {"reach_x": 1},
    "cells of r/2": {"reach": 2, "reach_x": 2},
}


def _kernel_time(
    config: Config, points: np.ndarray, cutoff: float, capacity: int, *, lists: bool = True, double: bool = False, **options: int
) -> tuple[float, dict[str, float], int, int]:
    """Return the seconds of one search and of each of its kernels, the longest row and the number of directed pairs."""
    wp = load_warp()
    cells_cuda = kernels_of("cells_cuda")

    scalar, n = (wp.float64 if double else wp.float32), len(points)
    kernels = cells_cuda.cell_kernels(3, double, False, lists, **options)
    kernels.load("cuda:0")
    x = wp.array(points.astype(np.float64 if double else np.float32), dtype=scalar, ndim=2, device="cuda")
    table = cells_cuda.table_cells(n)
    scratch = wp.empty(cells_cuda.scratch_words(n, n, 3, 2 if double else 1, True), dtype=wp.int32, device="cuda")
    idx = wp.empty((n, capacity) if lists else (1, 1), dtype=wp.int32, device="cuda")
    count, info = wp.empty(n, dtype=wp.int32, device="cuda"), wp.empty(2, dtype=wp.int32, device="cuda")
    radius = wp.array([cutoff], dtype=scalar, device="cuda")
    arguments = [x, x, radius, idx, count, info, scratch, n, n, 1, table, capacity if lists else 0, 0, 1]
    launches = kernels.launches(n, n, True)

    commands = [(launch.kernel, [*arguments, int(launch.of_queries)], launch.threads, launch.block) for launch in launches]
    until = _measure.time_kernels(commands, config.repeats)
    names = ("bounds", "lay_out", "count", "scan", "scatter", "gather", "query")
    stages = {f"{name}_s": float(s) for name, s in zip(names, np.diff([0.0, *until]), strict=True)}
    return until[-1], stages, int(info.numpy()[0]), int(count.numpy().sum(dtype=np.int64))


def _bandwidth_row(config: Config) -> dict[str, Any]:
    """Measure the ceiling: bytes read and written per second where nothing else is done."""
    import jax
    import jax.numpy as jnp

    x = jnp.ones(1 << 28, jnp.float32)
    copy = jax.jit(lambda x: x + 1)
    seconds = _timed(config, lambda: copy(x), calls=10)["median_s"]
    return {"kind": "ceiling", "method": "read and write", "bytes_per_s": 2 * x.nbytes / seconds, "median_s": seconds}
