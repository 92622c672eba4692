"""What a step of a simulation costs that keeps its neighbor list, beside one that makes it anew."""

import jax
import jax.numpy as jnp
import pandas as pd
from tqdm import tqdm

import jfrnn
from experiments import _layouts, _measure

BACKENDS = ("warp", "jax")


def skin_table(spacing: float, steps: int, repeats: int, skin: float = 0.1) -> pd.DataFrame:
    """Time updates inside a compiled scan over the thesis's full lattice: at rest, and moving skin per step.

    Args:
        spacing: Of the lattice [m]; 1e-4 makes 250 000 points.
        steps: Of the scan; what a scan copies once is shared by them. "jax", which takes seconds to rebuild, gets a tenth.
        repeats: Timed scans.
        skin: In cutoffs.

    Returns:
        One row per backend: points, skin [cutoffs], steps, milliseconds per step that keeps and that rebuilds (medians), their
        ratio, and how often each scan rebuilt.
    """
    scene = _layouts.make("full", spacing=spacing)
    x = jnp.asarray(scene.positions, jnp.float32)
    rows, kinds = [], (("keep", 0.0), ("rebuild", skin * scene.cutoff))
    bar = tqdm(total=2 * len(BACKENDS), desc="scans", leave=False)
    for backend in BACKENDS:
        nbrs = jfrnn.search(x, scene.cutoff, skin=skin * scene.cutoff, backend=backend)
        taken = steps if backend == "warp" else -(-steps // 10)
        row = {"backend": backend, "points": len(x), "skin": skin, "steps": taken}
        for name, velocity in kinds:
            bar.set_postfix_str(f"{backend}: {name}")
            seconds, rebuilds = _time_scan(x, nbrs, velocity, taken, repeats)
            bar.update()
            row |= {f"{name}_ms": 1e3 * seconds, f"{name}_rebuilds": rebuilds}
        rows.append(row | {"keep / rebuild": row["keep_ms"] / row["rebuild_ms"]})
    bar.close()
    return pd.DataFrame(rows)


def _time_scan(x: jax.Array, nbrs: jfrnn.NeighborList, velocity: float, steps: int, repeats: int) -> tuple[float, int]:
    """Return seconds per step, the median, and the number of rebuilds."""

    @jax.jit
    def run(x: jax.Array, nbrs: jfrnn.NeighborList) -> tuple[jax.Array, jax.Array]:
        def step(carry: tuple[jax.Array, jfrnn.NeighborList], _: None) -> tuple[tuple[jax.Array, jfrnn.NeighborList], None]:
            x, nbrs = carry
            x = x + x.dtype.type(velocity)
            return (x, nbrs.update(x)), None

        x, nbrs = jax.lax.scan(step, (x, nbrs), None, length=steps)[0]
        return x, nbrs.rebuild_count

    jax.block_until_ready(run(x, nbrs))
    (_, rebuilds), seconds = _measure.repeat(lambda: jax.block_until_ready(run(x, nbrs)), repeats, 0.0, repeats)
    return _measure.summarize(seconds)["median_s"] / steps, int(rebuilds)
