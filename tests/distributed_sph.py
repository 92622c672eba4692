"""Checks of the solver over many devices, in a process of their own, as `distributed_checks.py`."""

import sys
import tempfile
import warnings
from dataclasses import replace
from pathlib import Path

from distributed_checks import by_id, mesh_of  # isort: skip  # first: it asks for 8 devices
from children import CHECKS, check, main

CHECKS.clear()

import jax  # noqa: E402
import numpy as np  # noqa: E402

from jfrnn.sph import solver, spread  # noqa: E402
from jfrnn.sph.model import make_model, make_state  # noqa: E402
from jfrnn.sph.settings import make_scene  # noqa: E402


def begun(name, *settings):
    scene = make_scene(name, list(settings))
    model = make_model(scene, backend="warp")
    return model, jax.jit(solver.begin)(model, make_state(scene), None)


def same_states(ours, theirs, tolerance):
    for name, value in ours._asdict().items():
        expected = getattr(theirs, name)
        assert (value is None) == (expected is None), name
        if value is not None:
            scale = np.abs(expected).max()
            np.testing.assert_allclose(value, expected, rtol=0, atol=tolerance * scale, err_msg=name)


@check
def a_dam_break_runs_as_on_one_device_and_from_a_checkpoint_on_other_devices():
    """Summation, artificial viscosity, a tank: the source's dam."""
    model, s = begun("dam", "spacing=0.012")
    one, _ = solver.advance(model, s, None, 24)
    flow = spread.run(spread.spread(model, s, mesh_of(4), settle=5, slack=1.0), 12)
    with tempfile.TemporaryDirectory() as folder:
        spread.save(flow, Path(folder), 12)
        part = (Path(folder) / "000000012-00000.npz").read_bytes()
        (Path(folder) / "000000013-00000.npz").write_bytes(part)  # of a later step, whose other parts never came
        halfway, step = spread.load(Path(folder))
    assert step == 12
    same_states(halfway, spread.state_of(flow), 0)
    again = spread.run(spread.spread(model, halfway, mesh_of(2), settle=5), 12)
    same_states(spread.state_of(spread.run(flow, 12)), one, 1e-11)
    same_states(spread.state_of(again), one, 1e-11)


@check
def walls_and_carried_densities():
    """Continuity, dummy particles of walls, the Courant condition: the dam break in a tank with walls."""
    model, s = begun("dam-break-2d", "nx=5")
    one, _ = solver.advance(model, s, None, 8)
    flow = spread.spread(model, make_state(make_scene("dam-break-2d", ["nx=5"])), mesh_of(2, 2), settle=3)
    same_states(spread.state_of(spread.run(spread.begin(flow), 8)), one, 1e-11)


@check
def particles_that_enter():
    model, s = begun("jet", "duration=0.01")
    model, steps = replace(model, guided=np.where(np.arange(len(s.x)) % 2, model.guided, 0.0)), 20
    one, _ = solver.advance(model, s, None, steps)
    flow = spread.run(spread.spread(model, s, mesh_of(2), settle=4), steps)
    same_states(spread.state_of(flow), one, 1e-11)
    assert by_id(flow.particles.values["v"], flow.particles).shape == s.v.shape


if __name__ == "__main__":
    warnings.simplefilter("error")
    main(sys.argv[1:])
