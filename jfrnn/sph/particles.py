"""What a scene is made of once it is in JAX: a model, which stays, and a state, which moves. Both are pytrees."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, fields
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

import jfrnn
from jfrnn.cases import fluids
from jfrnn.cases.fluids import Gas, Physics, Scene, Turning
from jfrnn.sph.errors import SceneError
from jfrnn.sph.kernels import KERNELS, Kernel
from jfrnn.sph.pairs import reach
from jfrnn.sph.sight import Sight

Force = Callable[["State"], Array]
jax.tree_util.register_dataclass(
    fluids.Physics,
    data_fields=[item.name for item in fields(fluids.Physics) if item.name not in fluids.WORDS],
    meta_fields=list(fluids.WORDS),
)
jax.tree_util.register_dataclass(fluids.Gas, data_fields=["heat_ratio", "smoothing_ratio", "artificial"], meta_fields=["kernel"])
jax.tree_util.register_dataclass(fluids.Turning, data_fields=["center", "axis", "rate"], meta_fields=[])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Model:
    """What acts on which particles. Whatever is None is no part of the compiled program.

    Attributes:
        physics: `cases.fluids.Physics`; its words are static, its numbers may be traced.
        m: Masses [kg], shape [n].
        wall: Which particles are dummies of a wall, shape [n], bool.
        box: Periodic box.
        tank: Lower and upper corner [m] of a tank, shape [d] each.
        enters: When each particle enters [s], shape [n].
        step: Time step [s]; None: the Courant condition gives it.
        guided: How long a particle that entered keeps its velocity [s], shape [] or [n].
        spacing: Particle distance [m]. Static.
        fluid_count: How many particles stand before those of walls; None where there are no walls, or among the fluid. Static.
        backend: Of `jfrnn.pair_sum`. Static.
        turning: How the wall of triangles turns; None: it stays, or there is none.
        outflow: Lower and upper corner [m] of what particles leave for good, shape [d] each.
        force: A function of the state that returns accelerations [m/s²], shape [n, d], besides those of the physics; a
            `jax.tree_util.Partial`, whose arguments may be traced.
    """

    physics: Physics[Array, Array]
    m: Array
    wall: Array | None
    box: jfrnn.Box | None
    tank: tuple[Array, Array] | None
    enters: Array | None
    step: Array | None
    guided: Array | None
    spacing: float = field(metadata={"static": True})
    fluid_count: int | None = field(metadata={"static": True})
    backend: str = field(default="auto", metadata={"static": True})
    turning: Turning[Array, Array] | None = None
    outflow: tuple[Array, Array] | None = None
    force: Force | None = None

    @property
    def kernel(self) -> Kernel:
        """The smoothing kernel."""
        return KERNELS[self.physics.kernel]

    @property
    def fluid_mass(self) -> Array:
        """Masses [kg], shape [n], 0 of dummies of walls."""
        return self.m if self.wall is None else jnp.where(self.wall, 0, self.m)

    @property
    def cutoff(self) -> float:
        """Interaction radius of pairs [m]: that of the kernel and a little more, see `pairs.reach`."""
        return reach(self.kernel, self.physics.smoothing)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GasModel:
    """What acts on the particles of a gas.

    Attributes:
        physics: `cases.fluids.Gas`; its kernel is static, its numbers may be traced.
        m: Masses [kg], shape [n].
        step: Time step [s]; None: the Courant condition gives it.
        dim: Number of axes. Static.
        backend: Of `jfrnn.pair_sum`. Static.
        force: As in `Model`.
    """

    physics: Gas[Array]
    m: Array
    step: Array | None
    dim: int = field(metadata={"static": True})
    backend: str = field(default="auto", metadata={"static": True})
    force: Force | None = None
    enters: ClassVar[None] = None  # all are there, and there is no wall
    turning: ClassVar[None] = None

    @property
    def kernel(self) -> Kernel:
        """The smoothing kernel."""
        return KERNELS[self.physics.kernel]

    @property
    def fluid_mass(self) -> Array:
        """Masses [kg], shape [n]."""
        return self.m


class Beside(NamedTuple):
    """The wall as particles see it, where they are.

    Attributes:
        tri: Triangles that are near, in the frame of the wall.
        angle: By which it has turned [rad], shape []; None: it stands.
        mask: It is within reach, shape [n], bool.
        distance: To it [m], shape [n].
        normal: Away from it, of unit length, in its frame, shape [n, d].
        sight: Pairs that it parts; None: it is nowhere thin.
    """

    tri: jfrnn.TriangleList
    angle: Array | None
    mask: Array
    distance: Array
    normal: Array
    sight: Sight | None = None

    @property
    def overflow(self) -> Array:
        """Whether triangles or parted pairs may be missing because room was, shape [], bool."""
        return self.tri.overflow if self.sight is None else self.tri.overflow | self.sight.overflow


class Thermal(NamedTuple):
    """What particles of a gas have besides velocities.

    Attributes:
        u: Specific thermal energies [J/kg], shape [n].
        h: Smoothing lengths [m], shape [n].
        heating: Rates of u of the last evaluation [W/kg], shape [n].
        growth: Rates of ln h by the divergence of the flow then [1/s], shape [n].
    """

    u: Array
    h: Array
    heating: Array
    growth: Array


class State(NamedTuple):
    """What moves. Fields that the scene has no use for are None.

    Attributes:
        x: Positions [m], shape [n, d].
        v: Velocities [m/s], shape [n, d]; of "leapfrog" half a step behind.
        time: [s], shape [].
        a: Accelerations of the last evaluation [m/s²], shape [n, d].
        last: Step before this one [s], shape []; 0 at first.
        rho: Carried densities [kg/m³], shape [n].
        p: Carried pressures [Pa], shape [n].
        w: Velocities with which particles move besides v [m/s], shape [n, d].
        solid: The wall of triangles as particles see it.
        gas: What else moves in a gas.
        gone: Which particles have left by the outflow, shape [n], bool.
    """

    x: Array
    v: Array
    time: Array
    a: Array
    last: Array
    rho: Array | None = None
    p: Array | None = None
    w: Array | None = None
    solid: Beside | None = None
    gas: Thermal | None = None
    gone: Array | None = None


Flow = Model | GasModel


def active(model: Flow, s: State) -> Array | None:
    """Return which particles take part, shape [n], bool: those that have entered and not left; None where all do."""
    entered = None if model.enters is None else s.time >= model.enters
    if s.gone is None:
        return entered
    return ~s.gone if entered is None else entered & ~s.gone


def box_of(scene: Scene, dtype: Any) -> jfrnn.Box | None:  # noqa: ANN401
    """Return the periodic box of a scene, numbers of a dtype; None where space is open."""
    box = scene.periodic
    return box and jfrnn.Box(jnp.asarray(box.lengths, dtype), box.axes, jnp.asarray(box.lower, dtype))


def periods_from(box: jfrnn.Box, x: Array, about: Array | None = None) -> Array:
    """Return how far positions [n, d] are from their images in a box [m], shape [n, d], or from those nearest to a point [d]."""
    low = box.origin if about is None else about - box.vectors / 2
    turns = jnp.floor((x - low) / box.vectors)
    return jnp.where(jnp.asarray(box.periodic), turns * box.vectors, 0)


def wrapped(model: Flow, x: Array, about: Array | None = None) -> Array:
    """Return positions [n, d] in the periodic box, where there is one; or of their images those that are nearest to a point [d]."""
    box = getattr(model, "box", None)  # a gas has none
    return x if box is None else x - periods_from(box, x, about)


def mass_there(model: Flow, s: State) -> Array:
    """Return masses of the fluid [kg], shape [n]: 0 of dummies of walls, and of particles that take no part."""
    there = active(model, s)
    return model.fluid_mass if there is None else jnp.where(there, model.fluid_mass, 0)


def own_acceleration(model: Flow, s: State, dt: Array | None = None) -> Array | None:
    """Return what the own force of a model says [m/s²], shape [n, d]; None where it has none, a `SceneError` if it says none.

    It is given velocities at the time of positions: those of a state that stand dt/2 behind [s] are brought there by `s.a`.
    """
    if model.force is None:
        return None
    given, a = model.force(s if dt is None else s._replace(v=s.v + dt / 2 * s.a)), None
    with suppress(TypeError, ValueError):  # of what is no array
        a = jnp.asarray(given)
    if a is None or a.shape != s.x.shape or jnp.iscomplexobj(a):
        got = type(given).__name__ if a is None else f"{list(a.shape)}, {a.dtype}"
        raise SceneError(f"force must return accelerations [m/s²] of shape {list(s.x.shape)}, real numbers, got {got}.")
    return a.astype(s.x.dtype)
