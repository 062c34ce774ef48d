"""Line integrals, as an X-ray picture has them.

Along a ray with segments of lengths l_i, at whose ends the scalar is f_i and b_i and linear between
them, the integral of the scalar is the sum of l_i (f_i + b_i) / 2: exact on tetrahedra. Optical
depths S_i add up as they are. Sums are compensated, so that float32 keeps its digits over thousands
of cells.

The offset that the scalars of a volume are relative to (`TetMesh.offset`) comes back as so many
lengths: of f = c + g the integral is that of g plus c L, with L the length of the ray in the
volume.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp

from jaxvr._core.pytree import noun, static
from jaxvr._core.units import is_extreme, times_told
from jaxvr.composite.base import AbstractSum
from jaxvr.numerics import compensated
from jaxvr.numerics.compensated import Sum
from jaxvr.optics.analytic import Analytic
from jaxvr.optics.unshaded import Unshaded

Array = jax.Array
Of = Literal["scalar", "optical depth"]


class XRayState(NamedTuple):
    """Sums (R,): the integral, and the length of the ray in the volume."""

    integral: Sum
    length: Sum


@noun
class XRay(AbstractSum):
    """The integral along each ray of the scalar or of the extinction.

    of: "scalar": the integral of the field over world length, in its units times a length; the
        transfer function is not looked at, and may be None. "optical depth": that of the extinction
        of the transfer function.

    All three channels of the picture are the integral, which may be below 0 or above 1, and alpha
    is 1 where a ray meets the volume, else 0: show `image[..., 0]` with a scale of its own.

    Exact to rounding on tetrahedra with fields that are linear in each cell. Differentiable in
    values, points and camera, and of optical depth in the transfer function. The edge of the
    volume's silhouette has no derivative of its own there: the integral goes to 0 with the chord,
    and alpha steps. Where the largest scalar times the largest coordinate is not between 2^-100 and
    2^100 (2^-960 and 2^960 in float64) derivatives of the scalar's integral are NaN, since floats
    on their way are out of range; the picture is right as long as it is a normal float.

    Raises:
      ValueError: for another `of`.
    """

    of: Of = static(default="scalar")

    def __post_init__(self):
        if self.of not in get_args(Of):
            raise ValueError(f"of must be one of {list(get_args(Of))}, but is {self.of!r}.")

    @property
    def needs(self):
        return frozenset({"scalar"} if self.of == "scalar" else {"scalar", "optical_depth"})

    def default_integrator(self):
        return Unshaded() if self.of == "scalar" else Analytic()

    def init(self, rays, dtype):
        zero = jnp.zeros(rays, dtype)
        return XRayState((zero, zero), (zero, zero))

    def add(self, state, piece):
        front, back, length = piece.segment
        # Segments of no length too: they add nothing, but derivatives telescope only with theirs,
        # as on rays through vertices.
        here = piece.last
        length = jnp.where(here, length, 0)
        # Halves first: a sum of two scalars may overflow.
        more = jnp.where(here, length * (0.5 * front + 0.5 * back), 0)
        if self.of == "optical depth":
            more = piece.optical_depth
        return XRayState(
            compensated.add(state.integral, more), compensated.add(state.length, length)
        )

    def finish(self, state, transfer, scale):
        integral, length = (compensated.value(x) for x in state)
        if self.of == "scalar":
            # Products: of two quotients XLA makes one, by what may be no normal number.
            by_scalar, by_length = 1 / scale.scalar, 1 / scale.length
            good = ~is_extreme(by_scalar * by_length)
            integral = times_told(integral * by_scalar, by_length, good)
            if scale.offset is not None:
                integral = integral + scale.offset * (length / scale.length)
        hit = jnp.where(jax.lax.stop_gradient(length) > 0, 1, 0).astype(integral.dtype)
        return jnp.stack([integral, integral, integral, hit])

    def merge(self, front, back):
        return XRayState(*map(compensated.join, front, back))
