"""Density: by summation over neighbors, or by the rate that continuity gives it, with or without diffusion. Terms of a pair."""

from jax import Array

from jfrnn.sph.pairs import Pair, Values


def summation(pair: Pair, j: Values) -> Array:
    """Return m_j W, whose sum, the particle itself included, is ρ_i.

    Source: Gingold & Monaghan (1977), doi:10.1093/mnras/181.3.375.
    """
    return j["m"] * pair.weight


def continuity(pair: Pair, i: Values, j: Values, gradient: Array) -> Array:
    """Return ρ_i V_j (v_i - v_j)·∇W, whose sum is dρ_i/dt. Source: Monaghan (1994), doi:10.1006/jcph.1994.1034."""
    return i["rho"] * j["volume"] * ((i["v"] - j["v"]) @ gradient)


def diffusion(pair: Pair, i: Values, j: Values, strength: Array, hydrostatic: Array | None) -> Array:
    """Return δ-SPH's diffusive part of dρ_i/dt [kg/m³/s]: δhc Σ 2 V_j (ρ_j - ρ_i - ρᴴ_ij) (x_j - x_i)·∇W/r², where ·∇W/r² is -F.

    `strength` is δhc [m²/s], `hydrostatic` ρ0 g/c² [kg/m⁴], shape [d]: the gradient of the density at rest, which is not to be
    diffused. Source: Molteni & Colagrossi (2009), doi:10.1016/j.cpc.2008.12.004; the hydrostatic part as Fourtakas et al. (2019),
    doi:10.1016/j.compfluid.2019.06.009.
    """
    difference = j["rho"] - i["rho"]
    if hydrostatic is not None:
        difference = difference - hydrostatic @ pair.r
    return -2 * strength * j["volume"] * difference * pair.pull
