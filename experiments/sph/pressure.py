"""Pressure force, in the forms that are in use: each returns what neighbor j adds to the acceleration of i [m/s²], shape [d].

`gradient` is ∇W at i, [1/m^(d+1)], shape [d]. All forms but `difference` are antisymmetric in mass times acceleration: with them
momentum is kept to the rounding of the sums.
"""

from jax import Array

from experiments.sph.pairs import Pair, Values


def symmetric(pair: Pair, i: Values, j: Values, gradient: Array) -> Array:
    """Return -m_j (p_i/ρ_i² + p_j/ρ_j²) ∇W. Source: Monaghan (1992), doi:10.1146/annurev.aa.30.090192.002551."""
    return -j["m"] * (i["p"] / i["rho"] ** 2 + j["p"] / j["rho"] ** 2) * gradient


def mean(pair: Pair, i: Values, j: Values, gradient: Array) -> Array:
    """Return -m_j (p_i + p_j)/(ρ_i ρ_j) ∇W. Source: Colagrossi & Landrini (2003), doi:10.1016/S0021-9991(03)00324-3."""
    return -j["m"] * (i["p"] + j["p"]) / (i["rho"] * j["rho"]) * gradient


def volume(pair: Pair, i: Values, j: Values, gradient: Array) -> Array:
    """Return -(V_i² + V_j²) p_ij/m_i ∇W, p_ij the mean of the pressures weighed by the other's density.

    Source: Hu & Adams (2006), doi:10.1016/j.jcp.2005.09.001, eq. 16; Adami, Hu & Adams (2013), doi:10.1016/j.jcp.2013.01.043.
    """
    between = (j["rho"] * i["p"] + i["rho"] * j["p"]) / (i["rho"] + j["rho"])
    return -((i["m"] / i["rho"]) ** 2 + (j["m"] / j["rho"]) ** 2) * between / i["m"] * gradient


def difference(pair: Pair, i: Values, j: Values, gradient: Array) -> Array:
    """Return -V_j (p_j - p_i)/ρ_i ∇W, exact for linear pressures if the gradient is corrected; momentum is not kept exactly.

    Source: Negi & Ramachandran (2022), doi:10.1063/5.0098352.
    """
    return -j["m"] / j["rho"] * (j["p"] - i["p"]) / i["rho"] * gradient


def source(pair: Pair, i: Values, j: Values, gradient: Array) -> Array:
    """Return what the 2D source computes: -(m_j/ρ_j) (p_i + p_j)/2 ∇W/ρ_i, the gradient being that of the spiky kernel times h.

    Source: Müller, Charypar & Gross (2003), doi:10.2312/SCA03/154-159, eq. 10; ReCoDE-SPH-solver-2D-NS (2024).
    """
    return -j["m"] / j["rho"] * (i["p"] + j["p"]) / 2 * pair.h * gradient / i["rho"]


PRESSURES = {"symmetric": symmetric, "mean": mean, "volume": volume, "difference": difference, "source": source}
