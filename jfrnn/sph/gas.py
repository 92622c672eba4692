"""An ideal gas whose smoothing lengths follow its density: what is summed, the Courant condition, and a step.

The equations follow from a Lagrangian in which every particle has the smoothing length h_i that its own density asks for,
h_i = η (m_i/ρ_i)^(1/d), so that momentum and energy are conserved although resolution changes. Source: Springel & Hernquist (2002),
doi:10.1046/j.1365-8711.2002.05445.x; Price (2012), doi:10.1016/j.jcp.2010.12.011.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

import jfrnn
from jfrnn.cases.fluids import GasScene
from jfrnn.sph import budget
from jfrnn.sph.errors import SceneError
from jfrnn.sph.pairs import Neighbors, Pair, Values, total_of_own
from jfrnn.sph.particles import Beside, Force, GasModel, State, Thermal, own_acceleration

COURANT = 0.3
PASSES = 1  # of Newton's method in each step: the lengths of the step before, grown with the flow, are off by the square of a step
FIRST_PASSES = 25  # at first, when nothing is known
_FARTHEST = 0.3  # a pass changes the logarithm of a length by no more than this
_LEAST_OMEGA = 0.1  # particles that are alone have 0: their density says nothing about their length
_NOT_THERE = ("wall", "periodic", "tank", "sealed", "enters", "outflow", "densities", "pressures", "solid")
_PENETRATION = 3.0  # how much the velocities by which two particles approach each other add to the signal between them


class Density(NamedTuple):
    """Densities ρ [kg/m³] and Ω, shape [n] each, of which 1/Ω tells how much a density changes by its smoothing length."""

    rho: Array
    omega: Array


def make_model(scene: GasScene, dtype: type, backend: str, force: Force | None) -> GasModel:
    """Put what acts in a gas into JAX, numbers of one dtype.

    Raises:
        SceneError: The scene has what a gas here has not: walls, a box, particles that enter.
    """
    for name in _NOT_THERE:
        if getattr(scene, name) is not None:
            raise SceneError(f"{name} must be None in a scene of a gas, which is in open space, got {getattr(scene, name)!r}.")

    def array(value: Any) -> Array:  # noqa: ANN401
        return jnp.asarray(value, dtype)

    step = None if scene.step is None else array(scene.step)
    return GasModel(jax.tree.map(array, scene.physics), array(scene.masses), step, scene.dim, backend, force)


def make_state(scene: GasScene, dtype: type) -> State:
    """Put the particles of a gas into JAX, where they are at first; `begin` finds their smoothing lengths."""
    x, v, u = (jnp.asarray(each, dtype) for each in (scene.positions, scene.velocities, scene.energies))
    zero = jnp.zeros((), dtype)
    lengths = jnp.full_like(u, scene.physics.smoothing_ratio * scene.spacing)
    return State(x, v, zero, jnp.zeros_like(x), zero, gas=Thermal(u, lengths, jnp.zeros_like(u), jnp.zeros_like(u)))


def beside(scene: GasScene, x: Array, angle: Array | None) -> Beside | None:
    """Return None: a gas here has no walls."""


def begin(model: GasModel, s: State, nbrs: Neighbors = None) -> State:
    """Return the state with smoothing lengths, accelerations and rates of its positions, velocities and thermal energies."""
    u, first, *_ = thermal(s)
    h = jax.lax.fori_loop(0, FIRST_PASSES, lambda _, h: improve(model, h, sum_density(model, s.x, h)), first)
    return _evaluate(model, s, u, h)


def courant(model: GasModel, s: State) -> Array:
    """Return the time step [s], shape [], that signals and accelerations allow.

    The least of C h/(c + h|∇·v| + 1.2 α (c + 2 h max(-∇·v, 0))), C = `COURANT`, and 0.25 √(h/|a|). Source: Hernquist & Katz (1989),
    doi:10.1086/191344, sec. 2, with the divergence of the flow for the velocities by which pairs approach each other. Of those that
    have not met yet it says nothing: so none goes farther than C h in a step, as seen from the center of mass.
    """
    u, h, _, growth = thermal(s)
    c, spread = sound_speed(model, u), h * growth * model.dim
    signal = c + jnp.abs(spread)
    if model.physics.artificial is not None:
        signal = signal + 1.2 * model.physics.artificial * (c + 2 * jnp.maximum(-spread, 0))
    least = jnp.finfo(h.dtype).smallest_normal ** 0.5
    own = s.v - budget.momentum(model, s) / jnp.sum(model.m)
    a, v = (jnp.maximum(jnp.sum(each * each, axis=1), least) for each in (s.a, own))
    fastest = jnp.maximum(jnp.maximum(signal, jnp.sqrt(v)), least)
    return jnp.min(jnp.minimum(COURANT * h / fastest, 0.25 * jnp.sqrt(h) / a**0.25))


def step(model: GasModel, s: State, dt: Array, nbrs: Neighbors = None) -> tuple[State, Neighbors]:
    """Kick half, drift, kick half (velocity Verlet), thermal energies as velocities.

    Rates at the new positions are those of the velocities and energies that the rates before lead to.
    """
    u, h, heating, growth = thermal(s)
    middle, u = s.v + dt / 2 * s.a, u + dt / 2 * heating
    x, h = s.x + dt * middle, h * jnp.exp(dt * growth)
    for _ in range(PASSES):
        h = improve(model, h, sum_density(model, x, h))
    s = _evaluate(model, s._replace(x=x, v=middle + dt / 2 * s.a, time=s.time + dt), u + dt / 2 * heating, h)
    now = thermal(s)
    return s._replace(v=middle + dt / 2 * s.a, gas=now._replace(u=u + dt / 2 * now.heating)), None


def thermal(s: State) -> Thermal:
    """Return what a state of a gas has besides velocities."""
    assert s.gas is not None, "a state of a gas"
    return s.gas


def sound_speed(model: GasModel, u: Array) -> Array:
    """Return c = √(γ(γ-1)u) [m/s] of specific thermal energies [J/kg], shape [n]; its derivative is 0 where u is."""
    gamma = model.physics.heat_ratio
    warm = u > 0
    return jnp.where(warm, jnp.sqrt(gamma * (gamma - 1) * jnp.where(warm, u, 1)), 0)


def density_and_pressure(model: GasModel, s: State, nbrs: Neighbors = None) -> tuple[Array, Array]:
    """Return ρ = m (η/h)^d [kg/m³] and p = (γ-1)ρu [Pa], shape [n] each, of a state that has begun."""
    u, h, *_ = thermal(s)
    rho = model.m * (model.physics.smoothing_ratio / h) ** model.dim
    return rho, (model.physics.heat_ratio - 1) * rho * u


def list_neighbors(model: GasModel, s: State, skin: float, slack: float) -> jfrnn.NeighborList | None:
    """Return None: cutoffs change in every step."""


def energies(model: GasModel, s: State) -> dict[str, Array]:
    """Return kinetic and thermal energy, Σ m u [J; in 2D J/m], shape [] each, by name."""
    return {"kinetic": budget.kinetic_energy(model, s), "thermal": jnp.sum(model.m * thermal(s).u)}


def sum_density(model: GasModel, x: Array, h: Array) -> Density:
    """Return ρ_i = Σ m_j W(r_ij, h_i), the particle itself included, and Ω_i = 1 + h_i/(d ρ_i) Σ m_j ∂W/∂h.

    As h^d W is a function of r/h alone, Ω_i = -1/(d ρ_i) Σ m_j r² F(r_ij, h_i) with F = (dW/dr)/r, which is not negative. Source:
    Price (2012).
    """

    def term(own: Pair, other: Pair, i: Values, j: Values) -> dict[str, Array]:
        return {"rho": j["m"] * own.weight, "steep": -j["m"] * own.square * own.pull}

    dim = model.dim
    sums = total_of_own(term, x, {"m": model.m}, model.kernel, h, "gather", model.backend)
    rho = sums["rho"] + model.m * model.kernel.value(jnp.zeros_like(h), h, dim)
    return Density(rho, jnp.maximum(sums["steep"] / (dim * rho), _LEAST_OMEGA))


def improve(model: GasModel, h: Array, found: Density) -> Array:
    """Return lengths after a pass of Newton's method for ln(ρ h^d/(m η^d)) = 0, whose derivative in ln h is dΩ."""
    dim = model.dim
    off = jnp.log(found.rho / model.m) + dim * jnp.log(h / model.physics.smoothing_ratio)
    return h * jnp.exp(jnp.clip(-off / (dim * found.omega), -_FARTHEST, _FARTHEST))


def _evaluate(model: GasModel, s: State, u: Array, h: Array) -> State:
    """Return the state with these thermal energies and smoothing lengths, and the rates of all that moves.

    dv_i/dt = -Σ m_j (A_i ∇W(h_i) + A_j ∇W(h_j) + Π ∇W̄) and du_i/dt = Σ m_j (A_i (v_i - v_j)·∇W(h_i) + Π/2 (v_i - v_j)·∇W̄), with
    A = p/(Ωρ²) and ∇W̄ the mean of both gradients. Two particles that approach each other with w < 0 along their distance have
    Π = -α/2 v_sig w/ρ̄ with v_sig = c_i + c_j - 3 w, others 0. Source: Price (2012); of Π Monaghan (1997),
    doi:10.1006/jcph.1997.5732, with the signal as in Springel (2005), doi:10.1111/j.1365-2966.2005.09655.x, sec. 2.
    """
    rho, omega = sum_density(model, s.x, h)
    push = (model.physics.heat_ratio - 1) * u / (omega * rho)
    values = {"m": model.m, "v": s.v, "push": push}
    if model.physics.artificial is not None:
        values |= {"c": sound_speed(model, u), "rho": rho}

    def term(own: Pair, other: Pair, i: Values, j: Values) -> dict[str, Array]:
        towards = (j["v"] - i["v"]) @ own.r
        force = i["push"] * own.pull + j["push"] * other.pull
        opening = own.pull * towards
        if model.physics.artificial is None:
            return {"a": j["m"] * force * own.r, "opening": j["m"] * opening}
        drag = _viscosity(own, towards, i, j) * model.physics.artificial * (own.pull + other.pull) / 2
        return {"a": j["m"] * (force + drag) * own.r, "opening": j["m"] * opening, "heat": j["m"] * drag * towards / 2}

    sums = total_of_own(term, s.x, values, model.kernel, h, "either", model.backend)
    heating = push * sums["opening"] + sums.get("heat", 0)
    growth = -sums["opening"] / (omega * rho * model.dim)
    own = own_acceleration(model, s)
    return s._replace(a=sums["a"] if own is None else sums["a"] + own, gas=Thermal(u, h, heating, growth))


def _viscosity(pair: Pair, towards: Array, i: Values, j: Values) -> Array:
    """Return Π/α [m⁵/kg/s²] of a pair that meets with (v_j - v_i)·(x_j - x_i), 0 of one that parts."""
    apart = pair.square > 0
    w = jnp.where(apart, jnp.minimum(towards, 0) / jnp.where(apart, pair.distance, 1), 0)
    return -(i["c"] + j["c"] - _PENETRATION * w) * w / (i["rho"] + j["rho"])
