"""What a step of a simulation costs that keeps its neighbor list, beside one that makes it anew."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Annotated

import jax
import jax.numpy as jnp
import typer

import jfrnn
from experiments import _layouts, _measure
from experiments._commands import Spacing
from experiments._library import Name
from experiments.bench import table

BACKENDS = ("warp", "jax")
SKIN = 0.1  # in cutoffs
COLUMNS = ("backend", "points", "skin", "steps", "keep_ms", "keep_rebuilds", "rebuild_ms", "rebuild_rebuilds", "keep / rebuild")


def command(
    spacing: Spacing = 1e-4,
    steps: Annotated[int, typer.Option(min=1, max=1_000_000, help="Steps of a compiled scan.")] = 100,
    repeats: Annotated[int, typer.Option(min=2, max=100_000, help="Timed scans.")] = 3,
    out: Annotated[Path, typer.Option(help="Folder of the table.")] = Path("out") / "skin",
) -> str:
    """Time a step that keeps its neighbor list beside one that makes it anew."""
    parts = [(backend, partial(_rows, backend, spacing, steps, repeats)) for backend in BACKENDS]
    return table.text(table.measure(out, jax.default_backend(), parts, [spacing, steps, repeats], COLUMNS))


def _rows(backend: Name, spacing: float, steps: int, repeats: int) -> Iterator[table.Line]:
    """Time updates inside a compiled scan over the thesis's full lattice: at rest, and moving a skin per step.

    What a scan copies once is shared by its steps. "jax", which takes seconds to rebuild, gets a tenth of them.
    """
    scene = _layouts.make("full", spacing=spacing)
    x, skin = jnp.asarray(scene.positions, jnp.float32), SKIN * scene.cutoff
    nbrs = jfrnn.search(x, scene.cutoff, skin=skin, backend=backend)
    steps = steps if backend == "warp" else -(-steps // 10)
    row = {"backend": backend, "points": len(x), "skin": SKIN, "steps": steps}
    for name, velocity in (("keep", 0.0), ("rebuild", skin)):
        seconds, rebuilds = _time_scan(x, nbrs, velocity, steps, repeats)
        row |= {f"{name}_ms": 1e3 * seconds, f"{name}_rebuilds": rebuilds}
    yield row | {"keep / rebuild": row["keep_ms"] / row["rebuild_ms"]}


def _time_scan(x: jax.Array, nbrs: jfrnn.NeighborList, velocity: float, steps: int, repeats: int) -> tuple[float, int]:
    """Return seconds per step, the median, and the number of rebuilds."""
    run = compile_updates(velocity, steps)
    jax.block_until_ready(run(x, nbrs))
    (_, rebuilds), seconds = _measure.repeat(lambda: jax.block_until_ready(run(x, nbrs)), repeats, 0.0, repeats)
    return _measure.summarize(seconds)["median_s"] / steps, int(rebuilds)


def compile_updates(velocity: float, steps: int) -> Callable[[jax.Array, jfrnn.NeighborList], tuple[jax.Array, jax.Array]]:
    """Return a compiled scan that moves all particles and updates a list: from both to where they are and how often it was made."""

    @jax.jit
    def run(x: jax.Array, nbrs: jfrnn.NeighborList) -> tuple[jax.Array, jax.Array]:
        def step(carry: tuple[jax.Array, jfrnn.NeighborList], _: None) -> tuple[tuple[jax.Array, jfrnn.NeighborList], None]:
            x, nbrs = carry
            x = x + x.dtype.type(velocity)
            return (x, nbrs.update(x)), None

        x, nbrs = jax.lax.scan(step, (x, nbrs), None, length=steps)[0]
        return x, nbrs.rebuild_count

    return run
