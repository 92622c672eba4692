"""Collapse of a column as a perfect fluid does it: no friction, sound or surface tension. An answer that owes nothing to particles.

The potential of the velocity is harmonic, so its free surface is all there is to follow: nodes on it move with the fluid, their
potential by Bernoulli's equation (mixed Euler-Lagrange). Ground and left wall are mirrors. Lengths are in column widths a, times in
√(a/2g).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

Nodes = NDArray[np.float64]
GRAVITY = 0.5  # in these units


def fronts(times: Nodes, least: float = 0.02, step: float = 0.01, height: float = 2.0) -> Nodes:
    """Return how far the water reaches along the ground at times T = t √(2g/a), shape [k], increasing; at T = 0 it is 1.

    Args:
        times: When, shape [k]. Nodes of half the distance and half the step change fronts by 1 % at T = 0.85, by 2.5 % at 1.2: the
            tongue gets thinner than any distance of nodes.
        least: Distance of nodes at the front; it grows along the surface.
        step: Of a Runge-Kutta method of fourth order.
        height: Of the column.

    Source: Longuet-Higgins & Cokelet (1976), doi:10.1098/rspa.1976.0092.
    """
    z, phi = column(height, least)
    seen, time = [(0.0, z[-1, 0])], 0.0
    while time < times[-1]:
        z, phi = advance(z, phi, step)
        z, phi = spread(z, phi, least)
        time += step
        seen.append((time, z[-1, 0]))
    return np.interp(times, *np.array(seen).T)


def column(height: float, least: float) -> tuple[Nodes, Nodes]:
    """Return nodes on the surface of a column of width 1, from the left wall to the ground, shape [n, 2], and their potential."""
    corners = np.array([(0.0, height), (1.0, height), (1.0, 0.0)])
    return spread(corners, np.zeros(3), least)


def advance(z: Nodes, phi: Nodes, step: float) -> tuple[Nodes, Nodes]:
    """Return nodes and potential after a step."""
    rates, at = [], (z, phi)
    for share in (0.5, 0.5, 1.0, 0.0):
        rates.append(_rates(*at))
        at = (z + share * step * rates[-1][0], phi + share * step * rates[-1][1])
    move, change = (step / 6 * sum(w * rate[k] for w, rate in zip((1, 2, 2, 1), rates, strict=True)) for k in (0, 1))
    return z + move, phi + change


def spread(z: Nodes, phi: Nodes, least: float) -> tuple[Nodes, Nodes]:
    """Return as many nodes on the same line as it takes, close together at the front."""
    along = _along(z)
    from_front = [0.0]
    while from_front[-1] < along[-1]:
        from_front.append(from_front[-1] + min(0.05, least + 0.05 * from_front[-1]))
    at = along[-1] * (1 - np.array(from_front[::-1]) / from_front[-1])
    line = PchipInterpolator(along, np.column_stack([z, phi]))(np.clip(at, 0, along[-1]))
    line[0, 0], line[-1, 1] = 0.0, 0.0  # on the wall, on the ground
    return line[:, :2], line[:, 2]


def _rates(z: Nodes, phi: Nodes) -> tuple[Nodes, Nodes]:
    """Return velocities of nodes, and the rate of their potential, pressure being zero."""
    single, double = influences(z)
    across = np.linalg.solve(single, double @ phi - double.sum(axis=1) * phi)
    tangents = np.gradient(z, _along(z), axis=0, edge_order=2)
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    normals = np.column_stack([-tangents[:, 1], tangents[:, 0]])
    v = across[:, None] * normals + np.gradient(phi, _along(z), edge_order=2)[:, None] * tangents
    v[0, 0], v[-1, 1] = 0.0, 0.0
    return v, 0.5 * (v**2).sum(axis=1) - GRAVITY * z[:, 1]


def influences(z: Nodes) -> tuple[Nodes, Nodes]:
    """Return the integrals of (ln r)/2π and of its derivative along the normal over the surface and its mirror images.

    Potential and derivative change linearly between nodes; integrals over such pieces are exact, however close they come.

    Args:
        z: Nodes, shape [n, 2]; the fluid lies to the right of the way along them.

    Returns:
        Two matrices, shape [n, n]: what the value at a node (column) adds at a node (row).
    """
    n = len(z)
    single, double = np.zeros((n, n)), np.zeros((n, n))
    piece = z[1:] - z[:-1]
    length = np.hypot(*piece.T)
    tangent = piece / length[:, None]
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    for mirror in ((1, 1), (-1, 1), (1, -1), (-1, -1)):
        apart = z[:, None] * np.array(mirror) - z[:-1]
        start, off = (apart * tangent).sum(-1), (apart * normal).sum(-1)  # along the piece, and off its line
        off = np.where(np.abs(off) < 1e-12, 0.0, off)
        low, high = -start, length - start
        log_low, log_high = (0.5 * np.log(np.maximum(u**2 + off**2, 1e-26)) for u in (low, high))
        safe = np.where(off == 0, 1.0, off)
        angle = np.where(off == 0, 0.0, np.arctan(high / safe) - np.arctan(low / safe))
        plain = high * log_high - low * log_low - length + off * angle
        weighed = (high**2 + off**2) * log_high - (low**2 + off**2) * log_low - 0.5 * (high**2 - low**2)
        far = (0.5 * weighed + start * plain) / length
        far_normal = -(off * (log_high - log_low) + start * angle) / length
        single[:, 1:] += far
        single[:, :-1] += plain - far
        double[:, 1:] += far_normal
        double[:, :-1] += -angle - far_normal
    return single / (2 * np.pi), double / (2 * np.pi)


def _along(z: Nodes) -> Nodes:
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(z, axis=0).T))])
