"""Sort keys of faces, from their vertices: by centroid and by first vertex.

Callahan et al. 2005, section 5, sort faces by their centroid, or by the first vertex of each, which
is cheaper where vertices are sorted and faces follow: there are a dozen times fewer of them. The
distance from the eye is what grows along every ray of a pinhole camera; its square serves as well.
Along the parallel rays of an orthographic one it is the depth.

Keys are compared in float32, whatever the mesh's dtype. From an eye some hundred times as far as
the mesh is wide they begin to tie, and a k-buffer needs more entries (a box of 6^3 cubes: 2 from
nearby, 4 from 330 of its widths, 6 from 10^4, 12 from 10^5). From so far, an orthographic camera
sees the same.
"""

from __future__ import annotations

import abc
import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp

Array = jax.Array


class Faces(NamedTuple):
    """Faces (N,) as a bundle of rays sees them.

    slot (N,) int32: number of each. corners: coordinates (3, N) of three vertices, in the mesh's
    order, from the eye (pinhole) or from where rays start. forward (3,): the direction of view.
    pinhole (): whether the rays come from one point.
    """

    slot: Array
    corners: tuple[Array, Array, Array]
    forward: Array
    pinhole: Array


class AbstractOrder(abc.ABC):
    """A number for every face; those with smaller ones come first."""

    @abc.abstractmethod
    def keys(self, faces: Faces) -> Array:
        """Keys (N,), floats (compared in float32) or int32; faces of equal ones go by slot."""


@dataclasses.dataclass(frozen=True)
class Centroid(AbstractOrder):
    """By the distance of the centroid."""

    def keys(self, faces):
        a, b, c = faces.corners
        return distance((a + b + c) / 3, faces)


@dataclasses.dataclass(frozen=True)
class FirstVertex(AbstractOrder):
    """By the distance of the face's vertex with the lowest number."""

    def keys(self, faces):
        return distance(faces.corners[0], faces)


def distance(points: Array, faces: Faces) -> Array:
    """What grows with the distance (N,) of points (3, N) along rays: its square, or the depth where
    they are parallel."""
    x, y, z = points
    f = faces.forward
    square = x * x + y * y + z * z
    return jnp.where(faces.pinhole, square, x * f[0] + y * f[1] + z * f[2])
