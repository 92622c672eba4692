"""Timings on a GPU: searches, counts, sums and lists of scenes, what memory they take, and the bandwidth of the card."""

import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import jfrnn
from experiments import _compare, _measure
from experiments._library import load_warp, round_capacity
from experiments.bench import lists, ways
from experiments.bench.skin import compile_updates
from experiments.gpu.config import Config

# --- scenes -----------------------------------------------------------------------------------------------------------


def jitter_lattice(config: Config, n: int) -> np.ndarray:
    """Return a cubic lattice of spacing 1, every point moved at random, in random order: float32 [about n, 3]."""
    random = np.random.default_rng(config.seed)
    side = round(n ** (1 / 3))
    sites = np.stack(np.meshgrid(*[np.arange(side, dtype=np.float32)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    sites += random.uniform(-config.jitter_in_spacings, config.jitter_in_spacings, sites.shape).astype(np.float32)
    random.shuffle(sites)
    return sites


def _corners(config: Config, fill: float) -> np.ndarray:
    from jfrnn.cases import scene

    random = np.random.default_rng(config.seed)
    given = scene("corners", fill=fill)
    moved = given.positions / given.spacing + random.uniform(
        -config.jitter_in_spacings, config.jitter_in_spacings, given.positions.shape
    )
    return random.permutation(moved).astype(np.float32)


# --- memory ----------------------------------------------------------------------------------------------------------


def memory_rows() -> Iterator[dict[str, Any]]:
    """Compare `memory_plan` with the peak of JAX's allocator and of Warp's pool; first of all, since peaks only rise."""
    random = np.random.default_rng(0)
    blob = random.uniform(0, 8, (50_000, 3))
    scenes = {f"two blobs, {gap:.0e} cutoffs apart": np.concatenate([blob, blob + np.array([gap, 0, 0])]) for gap in (10.0, 1e6)}
    scenes["uniform"] = random.uniform(0, 60, (1_000_000, 3))
    jax.block_until_ready(jfrnn.search(jnp.asarray(blob[:1000], jnp.float32), 1.0, backend="warp").idx)  # libraries
    for name, points in scenes.items():
        x = jnp.asarray(points, jnp.float32)
        scene = lists.Scene(x, 1.0, np.asarray(jfrnn.count(x, 1.0, backend="warp")))
        search = jax.jit(lists.search(scene, backend="warp"))
        compiled: Any = search.lower(x).compile().memory_analysis()
        before = _measure.device_bytes("bytes_in_use")
        jax.block_until_ready(search(x))
        plan = jfrnn.memory_plan(len(points), 1.0, scene.capacity, backend="warp")
        yield {
            "kind": "memory", "method": "warp", "layout": name, "points": len(points), "capacity": scene.capacity,
            "planned_bytes": plan.total_bytes, "planned_scratch_bytes": plan.scratch_bytes,
            "compiled_bytes": compiled.temp_size_in_bytes + compiled.output_size_in_bytes,
            "peak_bytes": (_measure.device_bytes("peak_bytes_in_use") or 0) - (before or 0), "warp_pool_bytes": _warp_pool_bytes(),
        }  # fmt: skip


def _warp_pool_bytes() -> int:
    wp = load_warp()
    return wp.get_mempool_used_mem_high("cuda:0") if wp.is_cuda_available() else 0


# --- timings -------------------------------------------------------------------------------------------------------


def time_calls(config: Config, call: Callable[[], Any], calls: int | None = None) -> dict[str, Any]:
    """Time calls that are not waited for one by one; a repeat ends when the last is done."""
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


def scene_rows(config: Config, layout: str, size: float) -> Iterator[dict[str, Any]]:
    """Time searches of a scene: "jitter" of so many points, or "corners" of such a fill."""
    points = jitter_lattice(config, int(size)) if layout == "jitter" else _corners(config, size)
    x, cutoff, n = jnp.asarray(points), config.reach_in_spacings, len(points)
    exact = np.asarray(jfrnn.count(x, cutoff, backend="jax"))
    scene = lists.Scene(x, cutoff, exact)
    base = {"layout": layout, "points": n, "capacity": scene.capacity, "dtype": "float32"}
    base["exact_directed_pairs"] = int(exact.sum())
    for backend in ("warp", "hashgrid"):
        search = jax.jit(lists.search(scene, backend=backend))
        idx, count = search(x)
        again = search(x)
        row = {"kind": "call", "method": f"jfrnn {backend}", **base, "directed_pairs": int(np.asarray(count).sum(dtype=np.int64))}
        row["wrong"] = lists.wrong_counts(scene, count)
        row["same_bits_twice"] = bool((idx == again[0]).all() and (count == again[1]).all())
        if n <= 1_000_000:
            row["wrong"] += _compare.different_rows(idx, jax.jit(lists.search(scene, backend="jax"))(x)[0])
        del idx, count, again
        yield row | time_calls(config, lambda search=search: search(x))
    counts = jax.jit(lists.count(scene, backend="warp"))
    row = {"kind": "call", "method": "jfrnn warp, counts", **base, "directed_pairs": int(counts(x).sum())}
    yield row | time_calls(config, lambda: counts(x))
    if n <= 1_000_000:

        def step(x: Any, _: None) -> tuple[Any, Any]:  # noqa: ANN401
            idx, count = lists.search(scene, backend="warp")(x)
            return x + 0 * (idx[0, 0] + count[0]).astype(x.dtype), None

        steps = jax.jit(lambda x: lax.scan(step, x, None, length=config.steps)[0])
        yield {"kind": "scan", "method": "jfrnn warp", **base, "steps": config.steps} | _time_scan(config, lambda: steps(x))
    if layout == "jitter":
        yield from _loop_rows(config, base, scene)
        yield from sum_rows(config, base, x, cutoff)
    yield from _peer_rows(config, base, scene)


def _time_scan(config: Config, call: Callable[[], Any]) -> dict[str, Any]:
    """Time the steps of a scan."""
    return _measure.summarize([seconds / config.steps for seconds in time_calls(config, call, calls=3)["seconds"]])


def _loop_rows(config: Config, base: dict[str, Any], scene: lists.Scene) -> Iterator[dict[str, Any]]:
    """What a time loop adds: a periodic box, whose faces close the lattice, and updates of a list with a skin."""
    x, cutoff = scene.x, scene.cutoff
    box = jfrnn.Box([float(round(base["points"] ** (1 / 3)))] * 3, origin=-0.5)
    boxed = scene._replace(counts=np.asarray(jfrnn.count(x, cutoff, box=box, backend="warp")))
    search = jax.jit(lists.search(boxed, box=box, backend="warp"))
    row = {"kind": "call", "method": "jfrnn warp, periodic box", **base, "capacity": boxed.capacity}
    row |= {"directed_pairs": int(boxed.counts.sum(dtype=np.int64)), "exact_directed_pairs": None}
    if base["points"] <= 300_000:
        exact = np.asarray(jfrnn.count(x, cutoff, box=box, backend="jax"))
        row |= {"wrong": lists.wrong_counts(boxed, exact), "exact_directed_pairs": int(exact.sum(dtype=np.int64))}
    yield row | time_calls(config, lambda: search(x))
    if base["points"] > 1_000_000:
        return
    skin = 0.1 * cutoff
    wider = round_capacity(int(jfrnn.count(x, cutoff + skin, backend="warp").max()))
    nbrs = jfrnn.search(x, cutoff, skin=skin, capacity=wider, backend="warp")
    for name, velocity in (("keeps", 0.0), ("rebuilds", skin)):
        steps = compile_updates(velocity, config.steps)
        row = {"kind": "scan", "method": f"jfrnn warp, skin, {name}", **base, "capacity": wider, "steps": config.steps}
        yield row | {"rebuilds": int(steps(x, nbrs)[1])} | _time_scan(config, lambda steps=steps: steps(x, nbrs))


def sum_rows(config: Config, base: dict[str, Any], x: Any, cutoff: float) -> Iterator[dict[str, Any]]:  # noqa: ANN401
    """A density, and with it its gradient: without a list, and over lists that are made for it."""
    masses = np.random.default_rng(config.seed).uniform(0.5, 1.5, base["points"]).astype(np.float32)
    given = ways.Given(x, jnp.asarray(masses), cutoff)
    for way, gradient in itertools.product(config.sums, (False, True)):
        row: dict[str, Any] = {"kind": "sum", "method": way, "gradient": gradient, **base}
        try:
            steps = ways.WAYS[way].prepare(given, gradient, False)

            def call(steps: ways.Steps = steps) -> Any:  # noqa: ANN401
                return steps.sums(given.x, given.m, None if steps.build is None else steps.build(given.x))

            if base["points"] <= 1_000_000:
                row["error"] = ways.error_of(given, jax.device_get(call()), gradient)
            yield row | time_calls(config, call)
        except Exception as error:  # a way that is missing or out of memory says so in its row
            yield row | {"status": "failed", "reason": f"{type(error).__name__}: {error}"[:300]}


def _peer_rows(config: Config, base: dict[str, Any], scene: lists.Scene) -> Iterator[dict[str, Any]]:
    for name, make in (("warp HashGrid", _plain_hashgrid), ("nvalchemi 0.5.0 cell_list", _nvalchemi)):
        row: dict[str, Any] = {"kind": "call", "method": name, **base}
        try:
            call, pairs = make(scene)
            yield row | {"directed_pairs": pairs} | time_calls(config, call)
        except Exception as error:  # a peer that is missing or out of memory says so in its row
            yield row | {"status": "failed", "reason": f"{type(error).__name__}: {error}"[:300]}


def _plain_hashgrid(scene: lists.Scene) -> tuple[Callable[[], Any], int]:
    """Return a call of `wp.HashGrid` as Warp's examples use it, without JAX: build, then one thread per particle."""
    from experiments.methods._hashgrid_kernels import list_neighbors_kernel
    from experiments.methods.hashgrid_plain import Counts

    wp, n, capacity = load_warp(), len(scene.x), scene.capacity
    points = wp.array(np.asarray(scene.x), dtype=wp.vec3, device="cuda")
    grid = wp.HashGrid(128, 128, 128, device="cuda")
    idx, count = wp.empty((n, capacity), dtype=wp.int32, device="cuda"), wp.empty(n, dtype=wp.int32, device="cuda")

    def call() -> Counts:
        grid.build(points, scene.cutoff)
        given = [grid.id, points, scene.cutoff, capacity]
        wp.launch(list_neighbors_kernel, dim=n, inputs=given, outputs=[idx, count], device="cuda")
        return Counts(count)

    return call, int(call().array.numpy().sum(dtype=np.int64))


def _nvalchemi(scene: lists.Scene) -> tuple[Callable[[], Any], int]:
    search = lists.nvalchemi(scene)
    return (lambda: search(scene.x)), int(search(scene.x)[1].sum())


def _random_points(config: Config, n: int) -> tuple[Any, float]:
    """Return points made on the device, float32 [n, 3], and a cutoff: about 113 neighbors."""
    side = (n / 27.0) ** (1 / 3)  # 27 particles per cube of one cutoff
    return jax.random.uniform(jax.random.key(config.seed), (n, 3), jnp.float32, 0, side), 1.0


def large_rows(config: Config, n: int) -> Iterator[dict[str, Any]]:
    """Time counts, and sums if there are any, of so many random particles that a list of them would not fit.

    Rows of sums also say what the program takes beside its arguments.
    """
    x, cutoff = _random_points(config, n)
    base = {"layout": "random", "points": n, "dtype": "float32"}
    counts = jax.jit(lambda x: jfrnn.count(x, cutoff, backend="warp"))
    row = {"kind": "call", "method": "jfrnn warp, counts", **base, "directed_pairs": int(np.asarray(counts(x)).sum(dtype=np.int64))}
    yield row | time_calls(config, lambda: counts(x), calls=2) | {"peak_bytes": _measure.device_bytes("peak_bytes_in_use")}
    given = ways.Given(x, jnp.ones(n, jnp.float32), cutoff)
    for gradient in (False, True) if config.sums else ():
        sums = ways.WAYS["pair_sum warp"].prepare(given, gradient, False).sums
        memory: Any = jax.jit(sums).lower(x, given.m, None).compile().memory_analysis()
        row = {"kind": "sum", "method": "pair_sum warp", "gradient": gradient, **base}
        row |= {"compiled_bytes": memory.temp_size_in_bytes + memory.output_size_in_bytes}
        yield row | time_calls(config, lambda sums=sums: sums(x, given.m, None), calls=2)


def bandwidth_rows(config: Config) -> Iterator[dict[str, Any]]:
    """Measure the ceiling: bytes read and written per second where nothing else is done."""
    x = jnp.ones(1 << 28, jnp.float32)
    copy = jax.jit(lambda x: x + 1)
    seconds = time_calls(config, lambda: copy(x), calls=10)["median_s"]
    yield {"kind": "ceiling", "method": "read and write", "bytes_per_s": 2 * x.nbytes / seconds, "median_s": seconds}
