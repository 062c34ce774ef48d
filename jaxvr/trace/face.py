"""Where a ray crosses a face, from the 2D images of its vertices.

The ray is the origin of the plane. Twice the signed area of (origin, i, j) is the unnormalised
barycentric weight of the face's third vertex, so that one set of three numbers decides whether the
face contains the ray, and gives the depth and the scalar where it does (Platis and Theoharis 2003;
Aman, Demirci and Guedukbay 2022).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxvr._core.once import once
from jaxvr.numerics.exact import edge_side, halves, two_sum
from jaxvr.trace.shear import VALUE, X, Y, Z

Array = jax.Array
Face = tuple[Array, Array, Array]


def choose(mask: Array, yes: Any, no: Any) -> Any:
    """Selects ray by ray between trees of arrays (..., R)."""

    def one(a, b):
        return jnp.where(mask.reshape((1,) * (a.ndim - 1) + mask.shape), a, b)

    return jax.tree.map(one, yes, no)


class Crossing(NamedTuple):
    """A point of the ray: depth z + z_low from the eye, and scalar, (R,) each."""

    z: Array
    z_low: Array
    value: Array


@jax.custom_jvp
def _area(xi, yi, xj, yj, i_first):
    return edge_side(halves(xi), halves(yi), halves(xj), halves(yj), i_first)


@_area.defjvp
def _area_jvp(primals, tangents) -> Any:
    xi, yi, xj, yj, _ = primals
    dxi, dyi, dxj, dyj, _ = tangents
    area, positive = _area(*primals)
    change = xi * dyj + yj * dxi - xj * dyi - yi * dxj
    return (area, positive), (change, np.zeros(positive.shape, jax.dtypes.float0))


def edges(i: Array, j: Array, i_first: Array | bool) -> Array:
    """Twice the area of (origin, i, j) for pairs of vertices; right in sign even if zero.

    i, j (2, ..., R): projected coordinates. i_first (..., R): whether i comes before j in the
    mesh's order. Returns (..., R); zeros are signed, see `is_positive`.
    """
    area, positive = _area(*i, *j, jnp.broadcast_to(i_first, i.shape[1:]))
    # The area has the right sign already unless it is zero.
    return jnp.where(area == 0, jnp.where(positive, area + 0.0, -0.0 * (area + 1)), area)


def is_positive(area: Array) -> Array:
    """Sign of `edges`, which has one even at zero."""
    return ~jnp.signbit(area)


def sizes_of(area: Array) -> Array:
    """|area| of `edges`, with a derivative at zero too: that of the side that its sign names."""
    return jnp.where(is_positive(area), area, -area)


def face_edges(a: Array, b: Array, c: Array) -> tuple[Array, Array, Array]:
    """The edges (b, c), (c, a), (a, b) of a face, (R,) each, vertices in the mesh's order.

    The ray passes inside if their signs agree; then their sizes are the barycentric weights of
    a, b and c, unnormalised.
    """
    a, b, c = (v[: Y + 1] for v in (a, b, c))
    return edges(b, c, True), edges(c, a, False), edges(a, b, True)


def opposite_edges(a: Array, b: Array, c: Array) -> Array:
    """`face_edges` as one array (3, R)."""
    return jnp.stack(face_edges(a, b, c))


def _on_edge(face: Face) -> Array:
    """Weights for a ray that lies in the face's plane: all three images on a line through 0.

    The ray runs along the face; where it is said to cross is a matter of choice, as long as the
    point is on both. An edge whose ends lie on either side of 0, or at it, gives one.
    """
    size = [lax.stop_gradient(jnp.abs(v[X]) + jnp.abs(v[Y])) for v in face]
    done = jnp.zeros_like(size[0], bool)
    out = [jnp.zeros_like(size[0]) for _ in range(3)]
    for i, j in ((0, 1), (1, 2), (0, 2)):
        straddles = (face[i][X] * face[j][X] + face[i][Y] * face[j][Y] <= 0) & ~done
        both_at = (size[i] + size[j]) == 0
        out[i] = jnp.where(straddles, jnp.where(both_at, 1.0, size[j]), out[i])
        out[j] = jnp.where(straddles, size[i], out[j])
        done = done | straddles
    # Not reached with exact signs; any convex combination keeps the result finite.
    out[0] = jnp.where(done, out[0], 1.0)
    return jnp.stack(out)


def barycentric(face: Face, weights: Array) -> Array:
    """Coordinates (3, R) that sum to 1, from weights >= 0 (3, R).

    Derivative zero where the ray lies in the face's plane.
    """
    total = sum_of(weights)
    shares = weights / jnp.where(total == 0, 1, total)[None]
    return once(jnp.any(total == 0), _in_plane, shares, face, total)


def sum_of(three: Array) -> Array:
    a, b, c = three
    return a + b + c


def _in_plane(shares: Array, face: Face, total: Array) -> Array:
    weights = _on_edge(face)
    return jnp.where((total == 0)[None], weights / sum_of(weights)[None], shares)


def crossing(face: Face, weights: Array, eye: Array) -> Crossing:
    """The point of the ray in a face, from weights >= 0 (3, R); eye (R,): `ShearedRays.eye`."""
    return crossing_at(face, barycentric(face, weights), eye)


def crossing_at(face: Face, coordinates: Array, eye: Array) -> Crossing:
    """The point of a face with these barycentric coordinates (3, R).

    Differences are formed first, so that constants stay constant.
    """
    a, b, c = face
    _, of_b, of_c = coordinates
    a_z, a_low = two_sum(a[Z], -eye)
    z, lost = two_sum(a_z, of_b * (b[Z] - a[Z]) + of_c * (c[Z] - a[Z]))
    z, z_low = two_sum(z, lost + a_low)
    value = a[VALUE] + (of_b * (b[VALUE] - a[VALUE]) + of_c * (c[VALUE] - a[VALUE]))
    return Crossing(z, z_low, value)
