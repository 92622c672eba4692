"""What acts on the particles of a model: the parts that its scene has, put together. One sum over neighbors per stage."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jfrnn.sph import correction, density, solids, states, surface, transport, viscosity, walls
from jfrnn.sph.errors import SceneError
from jfrnn.sph.kernels import KERNELS
from jfrnn.sph.pairs import Neighbors, Pair, Term, Values, total
from jfrnn.sph.particles import Model, State, active, own_acceleration
from jfrnn.sph.pressure import PRESSURES, less_mean

_FEW = 0.5  # of what an evenly filled surrounding sums to


class Fields(NamedTuple):
    """What forces are made of: densities, pressures [n], velocities that viscosity sees [n, d], corrections [n, d, d] or None."""

    rho: Array
    p: Array
    u: Array
    inverse: Array | None


def are_resting(model: Model, s: State) -> Array | None:
    """Return which particles stay where they are, shape [n], bool: those of walls, and those that take no part."""
    there = active(model, s)
    return model.wall if there is None else _either(model.wall, ~there)


def are_guided(model: Model, s: State) -> Array | None:
    """Return which particles keep their velocity, shape [n], bool: those of walls, that have just entered, or that have left."""
    guided = model.wall
    if model.enters is not None and model.guided is not None:
        guided = _either(guided, s.time < model.enters + model.guided)
    return guided if s.gone is None else _either(guided, s.gone)


def _either(mask: Array | None, other: Array) -> Array:
    return other if mask is None else mask | other


def _sum(term: Term, model: Model, s: State, values: Values, nbrs: Neighbors, of: str = "all") -> Any:  # noqa: ANN401
    """Sum a term for all particles, for those of the "fluid", or for the "wall" over the fluid; other rows may be 0.

    Where a scene's walls stand behind its fluid, rows that nobody reads are not summed: walls are most of a shallow tank. A
    particle of the fluid then meets itself at r = 0, where terms of the fluid are 0.
    """
    options: dict[str, Any] = {"box": model.box, "backend": model.backend}
    if "rho" in values:  # per particle: a division per pair takes as long as the rest of a term
        values = values | {"specific": 1 / values["rho"], "volume": model.m / values["rho"]}
    values = values | {"m": model.m} | ({} if model.wall is None else {"wall": model.wall})
    entered, k = active(model, s), model.fluid_count
    if s.solid is not None and s.solid.sight is not None:
        if nbrs is not None:
            raise SceneError(
                "nbrs must be None beside a thin solid: which pairs it parts changes in every step, and a list keeps its pairs. "
                "Leave it out, so that sums search, as where `list_neighbors` returns None; or take Solid(thin=False), if water "
                "may feel water through it."
            )
        options["exclude"] = s.solid.sight.parted
    if k is None or nbrs is not None or of == "all" or "exclude" in options:
        return total(term, s.x, values, model.kernel, model.physics.smoothing, nbrs, active=entered, **options)
    rows, sources = (slice(0, k), slice(None)) if of == "fluid" else (slice(k, None), slice(0, k))
    mine, theirs = ({key: value[part] for key, value in values.items()} for part in (rows, sources))
    if of == "wall":
        del theirs["wall"]
    options |= {"active": None if entered is None else entered[sources], "queries": s.x[rows], "query_values": mine}
    sums = total(term, s.x[sources], theirs, model.kernel, model.physics.smoothing, **options)

    def whole(part: Array) -> Array:
        if entered is not None:
            part = jnp.where(entered[rows].reshape(-1, *[1] * (part.ndim - 1)), part, 0)
        nobody = jnp.zeros((model.m.shape[0] - part.shape[0], *part.shape[1:]), part.dtype)
        return jnp.concatenate([part, nobody] if of == "fluid" else [nobody, part])

    return jax.tree.map(whole, sums)


def _gradient(model: Model, pair: Pair, i: Values) -> Array:
    """Return ∇W at i, shape [d], corrected where the scene asks for it."""
    if model.physics.kernel == "poly6":  # not steep enough near 0: particles would cluster
        pair = Pair(pair.r, KERNELS["spiky"], pair.h)
    plain = -pair.pull * pair.r
    return i["inverse"] @ plain if "inverse" in i else plain


def fluid(j: Values, part: Any) -> Any:  # noqa: ANN401
    """Return what neighbor j adds if it belongs to the fluid, else 0; where there are no walls, what it adds."""
    return jnp.where(j["wall"], 0, part) if "wall" in j else part


def densities(model: Model, s: State, nbrs: Neighbors) -> Array:
    """Return densities [kg/m³], shape [n]: those that are carried, those of rest, or summed over neighbors and itself.

    Where the pressure is carried, those of rest; with a transport velocity, which keeps particles evenly spread, summed: volumes
    are then those that particles have.
    """
    physics = model.physics
    if s.rho is not None:
        return s.rho
    if s.p is not None and physics.transport is None:
        return jnp.broadcast_to(physics.density, s.x.shape[:1])
    own = model.kernel.value(jnp.zeros((), s.x.dtype), physics.smoothing, s.x.shape[1])
    return _sum(lambda pair, i, j: density.summation(pair, j), model, s, {}, nbrs) + model.m * own


def pressures(model: Model, s: State, rho: Array) -> Array:
    """Return pressures [Pa], shape [n]: those that are carried, or what the equation of state makes of densities."""
    physics = model.physics
    if s.p is not None:
        return s.p
    if physics.state == "linear":
        return states.linear(rho, physics.density, physics.sound_speed)
    return states.tait(rho, physics.density, physics.sound_speed, physics.exponent)


def corrections(model: Model, s: State, rho: Array, nbrs: Neighbors) -> Array | None:
    """Return what kernel gradients are multiplied with, shape [n, d, d], or None."""
    if not model.physics.corrected:
        return None

    def term(pair: Pair, i: Values, j: Values) -> Array:
        return correction.moment(pair, j, _gradient(model, pair, i))

    return correction.inverse(_sum(term, model, s, {"rho": rho}, nbrs, "fluid"))


def carried_rate(model: Model, s: State, rho: Array, inverse: Array | None, nbrs: Neighbors) -> Array:
    """Return the rate of the carried density [kg/m³/s] or pressure [Pa/s], shape [n]; walls have none."""
    physics, name = model.physics, "p" if s.rho is None else "rho"
    values = {"v": s.v, "rho": rho}
    values |= {key: value for key, value in (("p", s.p), ("w", s.w), ("inverse", inverse)) if value is not None}
    hydrostatic = None
    if physics.gravity is not None:
        hydrostatic = physics.density * physics.gravity / physics.sound_speed**2

    def term(pair: Pair, i: Values, j: Values) -> Array:
        gradient = _gradient(model, pair, i)
        within = 0  # diffusion is among the fluid: a wall's own value means nothing
        if name == "rho":
            rate = density.continuity(pair, i, j, gradient)
            if physics.density_diffusion is not None:
                strength = physics.density_diffusion * physics.smoothing * physics.sound_speed
                within = density.diffusion(pair, i, j, strength, hydrostatic)
        else:
            rate = transport.pressure_rate(pair, i, j, gradient, physics.density * physics.sound_speed**2)
            if physics.pressure_diffusion is not None:
                within = transport.pressure_diffusion(pair, i, j, physics.pressure_diffusion)
        if s.w is not None:
            within = within + transport.advected_change(pair, i, j, gradient, name)
        return rate + fluid(j, within)

    rate = _sum(term, model, s, values, nbrs, "fluid")
    return walls.keep_fluid(model.wall, rate if s.solid is None else rate + solids.compression(model, s, s.solid, rho))


def limit_tearing(model: Model, rho: Array) -> Array:
    """Return carried densities [kg/m³]: where a fluid tears, not less than that at rest."""
    return jnp.maximum(rho, model.physics.density) if model.physics.tears else rho


def fields(model: Model, s: State, rho: Array, inverse: Array | None, nbrs: Neighbors) -> Fields:
    """Return what forces are made of; at walls, what they show to the fluid."""
    p = pressures(model, s, rho)
    if model.wall is None:
        return Fields(rho, p, s.v, inverse)
    physics = model.physics
    sums = _sum(walls.wall_terms, model, s, {"rho": rho, "p": p, "v": s.v}, nbrs, "wall")
    wall_p, wall_u = walls.extrapolate(sums, s.v, physics.gravity)
    if physics.evolve == "pressure":
        wall_rho = rho
    elif physics.state == "linear":
        wall_rho = states.linear_density(wall_p, physics.density, physics.sound_speed)
    else:
        wall_rho = states.tait_density(wall_p, physics.density, physics.sound_speed, physics.exponent)
    u = s.v if physics.slip else walls.keep_fluid(model.wall, s.v, wall_u)
    return Fields(walls.keep_fluid(model.wall, rho, wall_rho), walls.keep_fluid(model.wall, p, wall_p), u, inverse)


def accelerations(model: Model, s: State, seen: Fields, nbrs: Neighbors, dt: Array | None = None) -> tuple[Array, Array | None]:
    """Return accelerations [m/s²], shape [n, d], and velocities by which particles move besides v [m/s], or None.

    Where velocities stand dt/2 behind positions [s], an own force is given those of the time of the positions.
    """
    physics = model.physics
    values = {"rho": seen.rho, "p": seen.p, "v": s.v, "u": seen.u}
    values |= {key: value for key, value in (("w", s.w), ("inverse", seen.inverse)) if value is not None}
    if physics.viscosity_form == "fourth" and physics.viscosity is not None:
        values["even"] = _even(model, s, seen.rho, nbrs)
    if s.p is not None and physics.transport is not None:
        values["mean"] = _mean_pressure(model, s, seen.p, nbrs)
    unit = model.kernel.value(jnp.asarray(model.spacing, s.x.dtype), physics.smoothing, s.x.shape[1])

    def term(pair: Pair, i: Values, j: Values) -> dict[str, Array]:
        gradient = _gradient(model, pair, i)
        along = PRESSURES[physics.pressure](pair, *(less_mean(i, j) if "mean" in i else (i, j)))
        if physics.artificial is not None:
            along = along + viscosity.artificial(pair, i, j, physics.artificial * physics.sound_speed)
        a = along * gradient
        if physics.viscosity is not None:
            drag = viscosity.VISCOSITIES[physics.viscosity_form](pair, i, j, physics.viscosity)
            a = a + (fluid(j, drag) if physics.slip else drag)
        if physics.tension is not None:
            a = a + surface.cohesion(pair, i, j, physics.tension, model.kernel.support * physics.smoothing)
        if physics.transport is not None:
            a = a + transport.advect(pair, i, j, gradient)
        if physics.shifting is not None:
            a = a + fluid(j, transport.advected_change(pair, i, j, gradient, "v"))
        sums = {"a": a}
        if physics.transport is not None:
            sums["w"] = transport.transport(pair, i, j, physics.transport)
        if physics.shifting is not None:
            sums["w"] = transport.spread(pair, i, j, unit)
        return sums

    sums = _sum(term, model, s, values, nbrs, "fluid")
    a = sums["a"] if physics.gravity is None else sums["a"] + physics.gravity
    own = own_acceleration(model, s, dt)
    if own is not None:
        a = a + own
    if s.solid is not None:
        a = a + solids.push(model, s, s.solid, seen.rho, seen.p)
    if physics.surface_tension is not None:
        a = a + _tension(model, s, seen.rho, nbrs, physics.surface_tension)
    if physics.damping is not None:
        until = physics.damped_until
        a = a - (physics.damping if until is None else jnp.where(s.time < until, physics.damping, 0)) * s.v
    return walls.keep_fluid(are_guided(model, s), a), sums.get("w")


def _even(model: Model, s: State, rho: Array, nbrs: Neighbors) -> Array:
    """Return what makes the Laplacian "fourth" right for r², a factor of each particle, shape [n]; 1 where neighbors are few."""
    sums = _sum(lambda pair, i, j: viscosity.evenness(pair, j), model, s, {"rho": rho}, nbrs)
    return jnp.where(sums > _FEW, 1 / jnp.where(sums > _FEW, sums, 1), 1)


def _mean_pressure(model: Model, s: State, p: Array, nbrs: Neighbors) -> Array:
    """Return Σ_j p_j/N_i [Pa], shape [n]: the plain mean over the N_i particles that the kernel reaches, i and walls among them.

    Source: Ramachandran & Puri (2019), doi:10.1016/j.compfluid.2018.11.023, of whose momentum equation for flows without a free
    surface it is the average pressure, after Basa, Quinlan & Lastiwka (2009), doi:10.1002/fld.1927.
    """
    sums = _sum(lambda pair, i, j: {"p": j["p"], "n": jnp.ones_like(j["p"])}, model, s, {"p": p}, nbrs)
    return (sums["p"] + p) / (sums["n"] + 1)


def _tension(model: Model, s: State, rho: Array, nbrs: Neighbors, tension: Array) -> Array:
    """Return accelerations by surface tension as a continuum force [m/s²], shape [n, d]; at walls there is no surface."""
    n = _sum(lambda pair, i, j: surface.inward(pair, j), model, s, {"rho": rho}, nbrs)
    normal, known = surface.directions(n, model.physics.smoothing)
    sums = _sum(surface.bend, model, s, {"rho": rho, "normal": normal, "known": known}, nbrs)
    return surface.continuum(sums, n, known, rho, tension)


def density_and_pressure(model: Model, s: State, nbrs: Neighbors = None) -> tuple[Array, Array]:
    """Return densities [kg/m³] and pressures [Pa] of a state, shape [n] each; at walls those that they show to the fluid."""
    rho = densities(model, s, nbrs)
    seen = fields(model, s, rho, None, nbrs)
    return seen.rho, seen.p
