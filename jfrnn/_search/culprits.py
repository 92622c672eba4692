"""Which particles made a search set a status bit, for the messages of errors."""

from typing import Any

import jax
import numpy as np

from jfrnn._engine import Inputs, rows_asked, take_present
from jfrnn._geometry import Radii, Status, is_radius

Host = Any  # an array of NumPy


def name_culprits(status: Status, inputs: Inputs) -> str:
    """Return a sentence about the first particle for each bit that is about particles; inputs are concrete."""
    present = take_present(inputs)
    asked = rows_asked(inputs)
    clouds = {"positions": (present.sources, present.active)} | ({} if inputs.queries is None else {"queries": asked})
    found: list[str] = []
    for name, (points, active) in clouds.items():
        x = np.asarray(jax.device_get(points))
        there = np.ones(len(x), bool) if active is None else np.asarray(jax.device_get(active))
        finite = np.isfinite(x).all(axis=1)
        if Status.NONFINITE in status:
            found += _first(there & ~finite, lambda at, name=name, x=x: f"{name}[{at}] is {x[at].tolist()}.")
        if Status.OUT_OF_RANGE in status and inputs.box is not None:
            found += _farthest(name, x, there & finite, inputs)
    if Status.INVALID_CUTOFF in status and isinstance(radii := inputs.cutoff, Radii) and radii.table is None:
        known: Any = np.asarray(jax.device_get(radii.queries if radii.sources is None else radii.sources))
        found += _first(~is_radius(known), lambda at: f"cutoff[{at}] is {known[at] / (2 if radii.summed else 1)}.")
    return " ".join(["", *found])


def _first(wrong: Host, tell: Any) -> list[str]:  # noqa: ANN401
    return [tell(int(np.argmax(wrong)))] if wrong.any() else []


def _farthest(name: str, x: Host, there: Host, inputs: Inputs) -> list[str]:
    """Name the point that is farthest from its box, in lattice vectors."""
    box, batch = inputs.box, inputs.batch
    if box is None or not there.any():
        return []
    vectors, origin = (np.asarray(jax.device_get(v), np.float64) for v in (box.vectors, box.origin))
    vectors = vectors[..., None] * np.eye(box.dim) if box.orthogonal else vectors
    flags = np.array(box.periodic) if box.flags is None else np.asarray(jax.device_get(box.flags))
    if box.per_system and batch is not None:
        systems = batch.of_queries if name == "queries" else batch.sources
        of = np.clip(np.asarray(jax.device_get(systems)), 0, len(vectors) - 1)
        vectors, origin, flags = vectors[of], origin[of], flags if flags.ndim == 1 else flags[of]
    units = np.where(
        flags, np.einsum("nd,...dk->nk" if vectors.ndim == 2 else "nd,ndk->nk", x - origin, np.linalg.pinv(vectors)), 0
    )
    away = np.where(there[:, None], np.abs(units), 0)
    at, axis = np.unravel_index(int(np.argmax(away)), away.shape)
    return [f"{name}[{at}] lies {units[at, axis]:.6g} lattice vectors away along axis {axis}."]
