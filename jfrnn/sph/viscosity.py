"""Viscosity: each function but `artificial` returns what neighbor j adds to the acceleration of i [m/s²], shape [d].

Velocities are read from `u`: those of particles, and of wall dummies what holds the fluid or lets it slip. All forms are
antisymmetric in mass times acceleration: with them momentum is kept to the rounding of the sums.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jfrnn.sph.kernels import Kernel
from jfrnn.sph.pairs import Pair, Values


def morris(pair: Pair, i: Values, j: Values, viscosity: Array) -> Array:
    """Return m_j (μ_i + μ_j)/(ρ_i ρ_j) F (u_i - u_j), μ = ρν, ν kinematic [m²/s].

    Source: Morris, Fox & Zhu (1997), doi:10.1006/jcph.1997.5776, eq. 22.
    """
    return viscosity * (i["rho"] + j["rho"]) * i["specific"] * j["volume"] * pair.pull * (i["u"] - j["u"])


def volume(pair: Pair, i: Values, j: Values, viscosity: Array) -> Array:
    """Return (V_i² + V_j²) ρ ν F (u_i - u_j)/m_i, ρ the harmonic mean of both, ν kinematic [m²/s].

    Source: Adami, Hu & Adams (2013), doi:10.1016/j.jcp.2013.01.043.
    """
    volumes = i["volume"] ** 2 + j["volume"] ** 2
    density = 2 * i["rho"] * j["rho"] / (i["rho"] + j["rho"])
    return volumes * density * viscosity * pair.pull * (i["u"] - j["u"]) / i["m"]


def fourth(pair: Pair, i: Values, j: Values, viscosity: Array) -> Array:
    """Return `morris` with F (a + b r²/h²) (e_i + e_j)/2 for F: a Laplacian of fourth order in h, right for r² on any particles.

    F alone takes 1 - k²<r²>/8 (in 3D /10) of the Laplacian of a wave of number k: a kernel's width makes the fluid less viscous. a
    and b take off that term; e is 1/`evenness` of each particle. The farthest neighbors count negative, so steps are shorter.

    Source: after Monaghan (1985), doi:10.1016/0021-9991(85)90006-3, who takes off the same term of interpolation.
    """
    return (i["even"] + j["even"]) / 2 * _factor(pair) * morris(pair, i, j, viscosity)


def evenness(pair: Pair, j: Values) -> Array:
    """Return -V_j F (a + b r²/h²) r²/d, whose sum is 1 where particles lie evenly on all sides."""
    return -j["volume"] * _factor(pair) * pair.pull * pair.square / pair.r.shape[0]


def _factor(pair: Pair) -> Array:
    a, b = _sharpen(pair.kernel, pair.r.shape[0])
    return a + b * pair.square / pair.h**2


@functools.cache
def _sharpen(kernel: Kernel, dim: int) -> tuple[float, float]:
    """Return a and b, such that the integral of F (a + b r²) r² is that of F r², and that of F (a + b r²) r⁴ is 0, h being 1."""
    q = (np.arange(1 << 12) + 0.5) / (1 << 12) * kernel.support
    with jax.ensure_compile_time_eval():
        slope = np.asarray(kernel.derivative(jnp.asarray(q)), np.float64)  # F r
    second, fourth, sixth = (np.sum(slope * q ** (dim + power)) for power in (0, 2, 4))
    a, b = np.linalg.solve([[second, fourth], [fourth, sixth]], [second, 0.0])
    return float(a), float(b)


def source(pair: Pair, i: Values, j: Values, viscosity: Array) -> Array:
    """Return what the 2D source computes: -μ (m_j/ρ_j) (u_i - u_j) 40/(πh⁴)(1 - q)/ρ_i, μ dynamic [Pa s].

    Source: Müller, Charypar & Gross (2003), doi:10.2312/SCA03/154-159, eq. 14 in 2D; ReCoDE-SPH-solver-2D-NS (2024).
    """
    laplacian = 40 / (jnp.pi * pair.h**4) * jnp.maximum(1 - pair.distance / pair.h, 0.0)
    return -viscosity * j["volume"] * laplacian * (i["u"] - j["u"]) * i["specific"]


def artificial(pair: Pair, i: Values, j: Values, strength: Array) -> Array:
    """Return the factor of ∇W in Monaghan's artificial viscosity, shape []: of particles that come closer, zero else.

    -m_j Π, Π = -αch φ/ρ̄, φ = v·r/(r² + h²/100) where that is negative; `strength` is αc [m/s]. Source: Monaghan (1992),
    doi:10.1146/annurev.aa.30.090192.002551.
    """
    approach = jnp.minimum((j["v"] - i["v"]) @ pair.r, 0.0)
    return 2 * strength * pair.h * j["m"] * approach / ((pair.square + 0.01 * pair.h**2) * (i["rho"] + j["rho"]))


def kinematic(form: str, viscosity: Array | float, rho: Array | float) -> Array | float:
    """Return ν [m²/s]: of "source", whose viscosity is the dynamic one, μ/ρ."""
    return viscosity / rho if form == "source" else viscosity


def longest_step(form: str, viscosity: Array | float, rho: Array | float, h: float) -> Array | float:
    """Return the time step [s] that viscosity allows with a Courant number of 0.25, 0.125 h²/ν; of "fourth", half of that.

    The fastest mode of "fourth" on a lattice decays 2.3 times as fast. Source: Morris, Fox & Zhu (1997),
    doi:10.1006/jcph.1997.5776.
    """
    return (0.0625 if form == "fourth" else 0.125) * h**2 / kinematic(form, viscosity, rho)


VISCOSITIES = {"morris": morris, "volume": volume, "fourth": fourth, "source": source}
