"""Error against seconds: Taylor-Green vortices by resolution, precision and way to find pairs, against their exact decay."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import product
from time import perf_counter
from typing import Annotated, Any

import numpy as np
from pydantic import Field, FiniteFloat

from experiments._config import Dtype, Positive, Table, digest
from experiments._library import taylor_green_velocity
from jfrnn.cases import fluids
from jfrnn.cases.fluids import FluidScene

_REYNOLDS = 100.0  # of the scene, by default


class Config(Table):
    """Runs of one flow."""

    nx: tuple[Annotated[int, Field(ge=8)], ...]  # resolutions
    dtypes: tuple[Dtype, ...] = ("float32", "float64")
    skins: tuple[Annotated[FiniteFloat, Field(ge=0)], ...] = (0.0,)  # of lists, in particle spacings; 0: no list, sums search
    duration: Positive = 0.5  # time that is simulated [s]

    def specs(self) -> Iterator["Spec"]:
        """Yield the runs."""
        for nx, dtype, skin in product(self.nx, self.dtypes, self.skins):
            yield Spec("taylor-green", nx, dtype, "list" if skin else "pair_sum", skin, self.duration)


@dataclass(frozen=True)
class Spec:
    """One run: fields as in `Config`."""

    scene: str
    nx: int
    dtype: str
    way: str
    skin: float
    duration: float
    steps: int = 0  # known when it ran

    @property
    def key(self) -> str:
        """Digest of all fields, 12 hex digits."""
        return digest({"kind": "tradeoff"} | asdict(self))


def measure(spec: Spec) -> dict[str, Any]:
    """Run it once and return the fields of its row: a worker's, whose precision is that of its process."""
    import jax

    jax.config.update("jax_enable_x64", spec.dtype == "float64")
    from experiments._measure import Bystanders
    from jfrnn.sph import solver
    from jfrnn.sph.model import make_model, make_state

    scene, dtype = fluids.fluid(spec.scene, nx=spec.nx), np.dtype(spec.dtype).type
    assert scene.step is not None, "errors are those after whole steps"
    model = make_model(scene, dtype)
    s = jax.jit(solver.begin)(model, make_state(scene, dtype))
    nbrs = solver.list_neighbors(model, s, spec.skin * scene.spacing) if spec.way == "list" else None
    steps = round(spec.duration / scene.step)
    jax.block_until_ready(solver.advance(model, s, nbrs, 1))
    bystanders, begin = Bystanders(), perf_counter()
    s, nbrs = jax.block_until_ready(solver.advance(model, s, nbrs, steps))
    row: dict[str, Any] = {"seconds": perf_counter() - begin, "others_cores": bystanders.cores(), "steps": steps}
    row |= {"particles": scene.n, "fluid": scene.n, "device": jax.devices()[0].device_kind}
    if nbrs is not None:
        row["rebuilds"] = int(nbrs.rebuild_count)
        if bool(nbrs.overflow):
            return row | {"status": "failed", "reason": "the list overflowed: a row holds more than it did at first"}
    error = _errors(scene, np.asarray(s.x, np.float64), np.asarray(s.v, np.float64), steps * scene.step)
    if not all(np.isfinite(value) for value in error.values()):
        return row | {"status": "failed", "reason": "the run diverged"}
    return row | {"status": "ok", "error": error}


def _errors(scene: FluidScene, x: np.ndarray, v: np.ndarray, time: float) -> dict[str, float]:
    """Return relative errors of positions and velocities [n, 2] at a time [s], by name."""
    exact = taylor_green_velocity(x, time, _REYNOLDS)
    speed, known = (np.linalg.norm(u, axis=1) for u in (v, exact))
    kinetic = 0.25 * np.exp(-16 * np.pi**2 * time / _REYNOLDS)
    error = {
        "l1 of speed": np.abs(speed - known).mean() / known.mean(),
        "l2 of velocity": np.linalg.norm(v - exact) / np.linalg.norm(exact),
        "kinetic energy": abs((v**2).sum() * scene.masses[0] / 2 / kinetic - 1),
    }
    return {name: float(value) for name, value in error.items()}
