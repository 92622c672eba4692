"""What keeps particles evenly spread: transport velocity and shifting; and EDAC, which carries the pressure."""

from jax import Array

from jfrnn.sph.pairs import Pair, Values


def transport(pair: Pair, i: Values, j: Values, background: Array) -> Array:
    """Return -(V_i² + V_j²) p_b/m_i ∇W [m/s²]: the acceleration by a constant background pressure, which moves particles alone.

    Source: Adami, Hu & Adams (2013), doi:10.1016/j.jcp.2013.01.043, eq. 13.
    """
    volumes = i["volume"] ** 2 + j["volume"] ** 2
    return volumes * background / i["m"] * pair.pull * pair.r


def advect(pair: Pair, i: Values, j: Values, gradient: Array) -> Array:
    """Return what transport by `w` besides v adds to the acceleration [m/s²]: the divergence of ρ v⊗w, in volume form.

    (V_i² + V_j²)/(2 m_i) (A_i + A_j)·∇W, A = ρ v⊗w. Source: Adami, Hu & Adams (2013), doi:10.1016/j.jcp.2013.01.043, eq. 8.
    """
    volumes = i["volume"] ** 2 + j["volume"] ** 2
    flow = i["rho"] * i["v"] * (i["w"] @ gradient) + j["rho"] * j["v"] * (j["w"] @ gradient)
    return volumes / (2 * i["m"]) * flow


def spread(pair: Pair, i: Values, j: Values, unit: Array) -> Array:
    """Return (1 + 0.2 (W/W(dx))⁴) V_j ∇W [1/m], whose sum points to where particles are dense; `unit` is W(dx) [1/m^d].

    Source: Sun et al. (2017), doi:10.1016/j.cma.2016.10.028, eq. 9, after Monaghan (2000), doi:10.1006/jcph.2000.6439.
    """
    return -(1 + 0.2 * (pair.weight / unit) ** 4) * j["volume"] * pair.pull * pair.r


def pressure_rate(pair: Pair, i: Values, j: Values, gradient: Array, stiffness: Array) -> Array:
    """Return ρ0c² V_j (v_i - v_j)·∇W [Pa/s], whose sum is dp_i/dt.

    Source: Ramachandran & Puri (2019), doi:10.1016/j.compfluid.2018.11.023.
    """
    return stiffness * j["volume"] * ((i["v"] - j["v"]) @ gradient)


def pressure_diffusion(pair: Pair, i: Values, j: Values, viscosity: Array) -> Array:
    """Return 2ν V_j F (p_i - p_j) [Pa/s], ν of EDAC. Source: as `pressure_rate`."""
    return 2 * viscosity * j["volume"] * pair.pull * (i["p"] - j["p"])


def advected_change(pair: Pair, i: Values, j: Values, gradient: Array, name: str) -> Array:
    """Return V_j (w_i·∇W)(f_j - f_i): the derivative of a quantity along w, with which particles move besides the fluid."""
    return j["volume"] * (i["w"] @ gradient) * (j[name] - i[name])
