"""A dam break in 2D by smoothed particles, and a gradient through the run: the front over gravity.

python examples/gallery/dam_break.py [PICTURE]
pip install -e '.[warp]' matplotlib
"""

import functools
import sys

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jfrnn

DX, RHO, SOUND, GRAVITY, TANK = 0.05, 1000.0, 40.0, 9.81, 4.0
H = 1.3 * DX
DT = 0.2 * H / SOUND


def slope(r):
    """Derivative of Wendland's C2 kernel in 2D over its distance; the support is 2 H."""
    q = jnp.sqrt(r @ r + 1e-12) / H
    return 7 / (4 * jnp.pi * H**4) * -5 * (1 - q / 2) ** 3


def rates(r, i, j):
    """Acceleration and rate of the density that j causes at i: pressures, an artificial viscosity."""
    m, v = RHO * DX**2, i["v"] - j["v"]
    approach = jnp.minimum(-(v @ r), 0.0) * H / (r @ r + 0.01 * H**2)
    viscous = -0.1 * SOUND * approach / RHO
    push = m * (i["p"] / i["rho"] ** 2 + j["p"] / j["rho"] ** 2 + viscous) * slope(r) * r
    return push, -m * (v @ r) * slope(r)


def step(state, gravity):
    """Move all particles by one step, the walls pushing those that are in them."""
    x, v, rho = state
    p = SOUND**2 * RHO / 7 * ((rho / RHO) ** 7 - 1)
    push, growth = jfrnn.pair_sum(rates, x, 2 * H, {"v": v, "p": p, "rho": rho})
    # into the walls
    low, high = jnp.maximum(DX / 2 - x, 0), jnp.maximum(x - jnp.array([TANK, 1e3]) + DX / 2, 0)
    v = v + DT * (push + gravity * jnp.array([0.0, -1.0]) + (SOUND / DX) ** 2 * (low - high) * 0.2)
    return x + DT * v, v, jnp.maximum(rho + DT * growth, RHO)  # a free surface does not pull


@functools.partial(jax.jit, static_argnums=1)
def run(gravity, steps, state):
    """Return the state after so many steps."""
    return jax.lax.fori_loop(0, steps, lambda _, s: step(s, gravity), state)


@functools.partial(jax.jit, static_argnums=1)
def front(gravity, steps, state):
    """Where the front is: a soft maximum of x. A scan can be differentiated in reverse."""
    x = jax.lax.scan(jax.checkpoint(lambda s, _: (step(s, gravity), None)), state, None, steps)[0][0]
    return DX * jax.nn.logsumexp(x[:, 0] / DX)


def main(nx=16, steps=1600, differentiated=100):
    """Print where the front is, and its slope over gravity; return the last state and its time [s]."""
    sites = np.stack(np.meshgrid(np.arange(nx), np.arange(2 * nx), indexing="ij"), axis=-1).reshape(
        -1, 2
    )
    x = jnp.asarray((sites + 0.5) * DX, jnp.float32)
    start = x, jnp.zeros_like(x), jnp.full(len(x), RHO, x.dtype)
    reached, change = jax.value_and_grad(front)(jnp.float32(GRAVITY), differentiated, start)
    print(
        f"{len(x)} particles; front after {differentiated} steps: {reached:.3f} m, its slope over "
        f"gravity {change:.1e} s²"
    )
    assert change > 0, "more gravity drives the front forward"
    return run(jnp.float32(GRAVITY), steps, start), steps * DT


if __name__ == "__main__":
    (x, v, _), time = main()
    figure, axes = plt.subplots(figsize=(7, 3.6))
    marks = axes.scatter(*x.T, c=jnp.linalg.norm(v, axis=1), s=6)
    figure.colorbar(marks, label="speed [m/s]", shrink=0.6)
    axes.set(aspect="equal", xlim=(0, TANK), ylim=(0, 1.6), xlabel="x [m]", ylabel="y [m]")
    axes.set_title(f"A column of water, {time:.2f} s after it was let go")
    figure.savefig(sys.argv[1] if len(sys.argv) > 1 else "dam_break.png", dpi=100, bbox_inches="tight")
