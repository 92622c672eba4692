"""Whether a run diverges, in which step, and which particle says so."""

import numpy as np

from jfrnn.cases.fluids import Scene
from jfrnn.sph import solids, solver, view
from jfrnn.sph.errors import DivergedError
from jfrnn.sph.pairs import Neighbors
from jfrnn.sph.particles import Flow, State


def complaint(scene: Scene, s: State) -> str | None:
    """Say which particle is not finite or went through a wall by more than half a spacing; None: all is well."""
    for name, value in (s._asdict() | ({} if s.gas is None else s.gas._asdict())).items():
        if name in _WORDS and value is not None and not np.isfinite(value := np.asarray(value)).all():
            particle = int(np.argwhere(~np.isfinite(value))[0][0])
            return f"particle {particle} has {_WORDS[name]} {value[particle]}"
    distances = solids.clearance(scene, s)
    if distances is not None and distances.min(initial=np.inf) <= 0:
        return f"particle {distances.argmin()} went through the wall of triangles, {-distances.min()} m deep"
    if scene.sealed is None:
        return None
    x, far = view.wrap_positions(scene, np.asarray(s.x)), scene.spacing / 2
    outside = ((x < np.array(scene.sealed.lower) - far) | (x > np.array(scene.sealed.upper) + far)).any(axis=1)
    if scene.wall is not None:
        outside &= ~scene.wall
    if s.gone is not None:
        outside &= ~np.asarray(s.gone)
    if not outside.any():
        return None
    particle = int(outside.argmax())
    return f"particle {particle} went through a wall, to {x[particle]} at {np.asarray(s.v)[particle]} m/s"


def check(scene: Scene, model: Flow, before: State, nbrs: Neighbors, after: State, steps: int, first: int) -> None:
    """Raise a `DivergedError` where a chunk of steps ended badly; its steps are run again to find the one in which it began.

    The chunk has so many steps after the first ones, and began with a state that was well, and the list of that time.
    """
    if (found := complaint(scene, after)) is None:
        return
    well, ill, at = 0, steps, after
    while ill - well > 1:
        middle = (well + ill) // 2
        s, _ = solver.advance(model, before, nbrs, middle)
        if (worse := complaint(scene, s)) is None:
            well = middle
        else:
            ill, found, at = middle, worse, s
    raise DivergedError(
        f"{scene.name}: diverged in step {first + ill}, t = {float(at.time):.6g} s: {found}. A smaller step may help."
    )


_WORDS = {"x": "position", "v": "velocity", "rho": "density", "p": "pressure", "u": "thermal energy", "h": "smoothing length"}
