"""Pressure force, in the forms that are in use: each returns the factor of ∇W in what neighbor j adds to the acceleration of i.

∇W is the gradient at i [1/m^(d+1)], shape [d]; factors have shape []. All forms but `difference` are antisymmetric in mass times
acceleration: with them momentum is kept to the rounding of the sums, unless pressures are `less_mean` or ∇W is corrected.
"""

from jax import Array

from jfrnn.sph.pairs import Pair, Values


def symmetric(pair: Pair, i: Values, j: Values) -> Array:
    """Return -m_j (p_i/ρ_i² + p_j/ρ_j²). Source: Monaghan (1992), doi:10.1146/annurev.aa.30.090192.002551."""
    return -j["m"] * (i["p"] * i["specific"] ** 2 + j["p"] * j["specific"] ** 2)


def mean(pair: Pair, i: Values, j: Values) -> Array:
    """Return -m_j (p_i + p_j)/(ρ_i ρ_j). Source: Colagrossi & Landrini (2003), doi:10.1016/S0021-9991(03)00324-3."""
    return -j["volume"] * (i["p"] + j["p"]) * i["specific"]


def volume(pair: Pair, i: Values, j: Values) -> Array:
    """Return -(V_i² + V_j²) p_ij/m_i, p_ij the mean of the pressures weighed by the other's density.

    Source: Hu & Adams (2006), doi:10.1016/j.jcp.2005.09.001, eq. 16; Adami, Hu & Adams (2013), doi:10.1016/j.jcp.2013.01.043.
    """
    between = (j["rho"] * i["p"] + i["rho"] * j["p"]) / (i["rho"] + j["rho"])
    return -(i["volume"] ** 2 + j["volume"] ** 2) * between / i["m"]


def difference(pair: Pair, i: Values, j: Values) -> Array:
    """Return -V_j (p_j - p_i)/ρ_i, exact for linear pressures if the gradient is corrected; momentum is not kept exactly.

    Source: Negi & Ramachandran (2022), doi:10.1063/5.0098352.
    """
    return -j["volume"] * (j["p"] - i["p"]) * i["specific"]


def source(pair: Pair, i: Values, j: Values) -> Array:
    """Return what the 2D source computes: -(m_j/ρ_j) (p_i + p_j)/2 h/ρ_i, the gradient being that of the spiky kernel.

    Source: Müller, Charypar & Gross (2003), doi:10.2312/SCA03/154-159, eq. 10; ReCoDE-SPH-solver-2D-NS (2024).
    """
    return -j["volume"] * (i["p"] + j["p"]) / 2 * pair.h * i["specific"]


def less_mean(i: Values, j: Values) -> tuple[Values, Values]:
    """Return both with pressures less `mean` of i, which the sum does not feel where particles lie evenly; momentum is not kept.

    In `volume`, p_ij is then (ρ_j (p_i - p̄_i) + ρ_i (p_j - p̄_i))/(ρ_i + ρ_j). Source: Ramachandran & Puri (2019),
    doi:10.1016/j.compfluid.2018.11.023, after Basa, Quinlan & Lastiwka (2009), doi:10.1002/fld.1927.
    """
    return i | {"p": i["p"] - i["mean"]}, j | {"p": j["p"] - i["mean"]}


PRESSURES = {"symmetric": symmetric, "mean": mean, "volume": volume, "difference": difference, "source": source}
