"""Small scenes of fluids, and scenes with other physics."""

from dataclasses import replace

import numpy as np

from jfrnn.cases import fluids


def scene_of(positions, spacing, physics, **more):
    """Return a scene of particles at rest for a second, each of which fills its place in a lattice."""
    n, dim = positions.shape
    given = {"name": "small", "velocities": np.zeros((n, dim)), "masses": np.full(n, physics.density * spacing**dim)}
    given |= {"positions": positions, "spacing": spacing, "duration": 1.0, "step": None, "physics": physics}
    return fluids.FluidScene(**given | more)


def changed(scene, **physics):
    """Return a scene with other physics."""
    return replace(scene, physics=replace(scene.physics, **physics))
