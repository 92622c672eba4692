"""Surface tension of free surfaces: by cohesion, with which particles attract each other, or as a continuum force by curvature."""

import jax.numpy as jnp
from jax import Array

from jfrnn.sph.pairs import Pair, Values


def cohesion(pair: Pair, i: Values, j: Values, strength: Array, reach: float) -> Array:
    """Return γ m_j C(r/reach) (x_j - x_i)/r [m/s²], antisymmetric in mass times acceleration.

    C(q) = 128 (1-q)³q³ - 1 for q ≤ 1/2, then 64 (1-q)³q³, 0 from q = 1 on: repulsion below q = 0.28, attraction beyond. `strength`
    is γ [m/s²/kg]. Source: Akinci, Akinci & Teschner (2013), doi:10.1145/2508363.2508395, eq. 2 (the spline without its norm).
    """
    q = jnp.minimum(pair.distance / reach, 1.0)
    bump = 64 * (1 - q) ** 3 * q**3
    spline = jnp.where(q > 0.5, bump, 2 * bump - 1)
    apart = pair.square > 0
    return strength * j["m"] * spline * pair.r / jnp.where(apart, pair.distance, 1)


def inward(pair: Pair, j: Values) -> Array:
    """Return V_j ∇W [1/m], shape [d], whose sum n, the gradient of a color that is 1 in the fluid, points inward at surfaces."""
    return -j["m"] / j["rho"] * pair.pull * pair.r


def directions(n: Array, h: float, least: float = 0.2) -> tuple[Array, Array]:
    """Return unit vectors along n, shape [n, d], and which of them say where a surface is, shape [n]: the others are 0.

    n are sums of `inward` [1/m], and |n| h is 0.7 at a flat surface, and up to 0.1 from disorder alone. Source: Morris (2000),
    doi:10.1002/1097-0363(20000615)33:3<333::AID-FLD11>3.0.CO;2-7, eq. 20.
    """
    square = jnp.sum(n * n, axis=1)
    known = square > (least / h) ** 2
    return jnp.where(known[:, None], n / jnp.sqrt(jnp.where(known, square, 1))[:, None], 0), known


def bend(pair: Pair, i: Values, j: Values) -> dict[str, Array]:
    """Return what a curvature is made of, of neighbors j that know where the surface is: V_j F (n_i - n_j)·t, and V_j F t².

    t is the part of r along the surface. Across it normals differ by noise alone, which would always count as curvature of a drop:
    40 to 100 % of it, on discs cut from a lattice. Neighbors j are `known` if their `normal` is a unit vector.
    """
    along = pair.r - (i["normal"] @ pair.r) * i["normal"]
    weight = jnp.where(j["known"], j["m"] / j["rho"] * pair.pull, 0)
    return {"bend": weight * ((i["normal"] - j["normal"]) @ along), "spread": weight * (along @ along)}


def continuum(sums: dict[str, Array], n: Array, known: Array, rho: Array, tension: Array) -> Array:
    """Return accelerations 2 σ κ n/ρ [m/s²], shape [n, d], κ = (d-1) Σ V_j F (n_i - n_j)·t/Σ V_j F t².

    Twice, because half of the band in which the color changes is outside, where nothing is: as between fluids of which one has no
    density. Momentum is kept as well as curvature is known: not exactly. n are sums of `inward` [1/m], shape [n, d], `tension` is σ
    [N/m]. Source: Brackbill, Kothe & Zemach (1992), doi:10.1016/0021-9991(92)90240-Y; Adami, Hu & Adams (2010),
    doi:10.1016/j.jcp.2010.03.022, eqs. 15 and 20, of which the latter takes r in place of t.
    """
    met = known & (sums["spread"] < 0)
    curvature = jnp.where(met, (n.shape[1] - 1) * sums["bend"] / jnp.where(met, sums["spread"], -1), 0)
    return (2 * tension * curvature / rho)[:, None] * n
