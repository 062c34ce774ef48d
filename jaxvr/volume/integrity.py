"""Whether the integers of a mesh are those of a mesh (NumPy, not traced).

A mesh is a pytree, and pytrees are computed with: an average of two, a step of an optimiser over
all leaves, a copy with one array put in by hand. Integers that come out of that name other cells
and points than they should, or none, and a walk that follows them has no picture to give. So verbs
look before they start, at each array once: those of a mesh that was built are known to be right.

The checks are those of the invariants in `TetMesh`: kinds and shapes; points and values finite; the
corners of a cell four different points in the order of their welded ids; the cell across a face
names this one in return, and has the face's three points; each face without a neighbour is in the
boundary, once; and the bits follow from each other: all words that name a cell have it turned or
none, a seam is where ids differ, the entries of a component go together, and fit its points.

Under a user's jit nothing is known; there `hold` makes a status of most of it.
"""

from __future__ import annotations

import weakref
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from .._core.checks import is_concrete, require_finite
from .._core.status import BROKEN, LOST
from . import packing
from .connectivity import FACES, entries_agree
from .mirror import enclosed, mirrored, outer_faces

Array = jax.Array

_ADVICE = (
    "Connectivity cannot be computed with: apply functions such as jax.tree.map to mesh.points and "
    "mesh.values and use mesh.replace(...), or build the mesh anew."
)

# By ids of arrays, and of how many points they name some: what was found right.
_known: dict[tuple[int, ...], tuple[weakref.ref, ...]] = {}


def found_right(arrays: tuple[Any, ...], n_points: int = 0) -> bool:
    found = _known.get((n_points, *map(id, arrays)))
    return found is not None and all(
        ref() is array for ref, array in zip(found, arrays, strict=True)
    )


def remember(arrays: tuple[Any, ...], n_points: int = 0) -> None:
    key = (n_points, *map(id, arrays))

    def forget(_: Any) -> None:
        _known.pop(key, None)

    # NumPy's arrays can be written to, so what was seen in them need not stay.
    if all(isinstance(array, jax.Array) for array in arrays):
        _known[key] = tuple(weakref.ref(array, forget) for array in arrays)


def _connectivity(mesh: Any) -> tuple[Any, ...]:
    return mesh.cells, mesh.neighbors, mesh.boundary, mesh.duplicates


def trust(mesh: Any) -> Any:
    """The mesh, whose arrays were just made by `build`."""
    remember(_connectivity(mesh), mesh.points.shape[0])
    remember((mesh.points,))
    remember((mesh.values,))
    return trust_entries(mesh)


def trust_entries(mesh: Any) -> Any:
    """The mesh, whose `entry` bits are known to fit its points."""
    remember((mesh.points, *_connectivity(mesh)))
    return mesh


def require_mesh(mesh: Any) -> None:
    """ValueError that names the array and the first entry that is wrong. Of numbers that are traced
    only kinds and shapes are looked at."""
    require_connectivity(mesh)
    for name, x in (("points", mesh.points), ("values", mesh.values)):
        if is_concrete(x) and not found_right((x,)):
            require_finite(f"mesh.{name}", x)
            remember((x,))
    connectivity = _connectivity(mesh)
    if is_concrete(mesh.points, *connectivity) and not found_right((mesh.points, *connectivity)):
        if mirrored(mesh.points, mesh.cells, mesh.neighbors, mesh.boundary)[0] is not None:
            raise ValueError(
                "mesh.points turn the mesh, or a component of it, inside out, and mesh.boundary "
                "still says where rays entered before: the picture would be blank. Points that "
                "were mirrored go through mesh.replace(points=...)."
            )
        trust_entries(mesh)


def require_connectivity(mesh: Any) -> None:
    """The part of `require_mesh` that is about integers, whatever the numbers are."""
    _require_kinds(mesh)
    connectivity = _connectivity(mesh)
    n_points = mesh.points.shape[0]
    if is_concrete(*connectivity) and not found_right(connectivity, n_points):
        cells, neighbors, boundary, duplicates = map(np.asarray, connectivity)
        _require_connectivity(cells, neighbors, boundary, duplicates, n_points)
        remember(connectivity, n_points)


def hold(mesh: Any, bits: Array) -> Array:
    """Status bits of any shape, with BROKEN where integers are traced and not those of a mesh, or
    where traced points turn the mesh inside out, and LOST where points are not finite.

    It costs as much as some tens of thousands of rays where integers are traced, a pass over the
    boundary where points are (and some over the cells, in several components), and nothing where
    both are known: close over the mesh, and pass `mesh.replace(...)` what is traced.
    """
    if not _is_traced(mesh):
        return bits
    good = _is_right_way_round(mesh)
    if not is_concrete(*_connectivity(mesh)):
        good &= _fits(mesh.points.shape[0], *_connectivity(mesh))
        if not mesh.report.one_sided:  # such components have no rule for their entries
            good &= _is_closed(mesh)
    bits = jnp.where(good, bits, bits | BROKEN)
    # a ray may pass a face that is nowhere without meeting it
    return jnp.where(jnp.isfinite(mesh.points).all(), bits, bits | LOST)


def unasked(mesh: Any, image: Array, bits: Array) -> Array:
    """An image (..., 4) whose status (...) nobody asks for: NaN, and so are gradients, where `hold`
    found the mesh broken. Without that a wrong picture would look like another."""
    if is_concrete(bits) or not _is_traced(mesh):
        return image
    broken = (bits & BROKEN) != 0
    return image * jnp.where(broken, jnp.nan, 1).astype(image.dtype)[..., None]


def in_range(mesh: Any, compiled: bool) -> Array:
    """Whether integers () of a mesh name points and cells that it has. Compiled loops look at those
    of cells themselves, as they load them."""
    count = mesh.cells.shape[0]
    good = jnp.all((mesh.boundary >= 0) & (mesh.boundary >> 4 < count))
    if compiled:
        return good
    cells, words = mesh.cells, mesh.neighbors
    good = good & jnp.all((cells >= 0) & (cells < mesh.points.shape[0]))
    return good & jnp.all((words >= -1) & (words >> 4 < count))


def _is_traced(mesh: Any) -> bool:
    return not is_concrete(mesh.points, *_connectivity(mesh))


def _is_right_way_round(mesh: Any) -> Array:
    """Whether () the boundary of each component encloses a volume that is not below 0, but for
    rounding. Where some components are one-sided, and enclose nothing, they are taken together."""
    if not mesh.boundary.shape[0]:
        return jnp.asarray(True)
    known = lax.stop_gradient(mesh.points), mesh.cells, mesh.boundary, jnp
    if mesh.report.components == 1 or mesh.report.one_sided:
        volume, error = enclosed(*known)
        return ~(volume.sum() < -error.sum())
    label = components_of(mesh.neighbors)
    label = label[jnp.clip(packing.cell_of(mesh.boundary), 0, len(label) - 1)]
    sums = (jnp.zeros(len(mesh.cells), x.dtype).at[label].add(x) for x in enclosed(*known, label))
    volume, error = sums
    return ~jnp.any(volume < -error)


def components_of(neighbors: Array) -> Array:
    """The lowest cell (T,) of each cell's component, from the words (T, 4) of a mesh.

    Labels of neighbours are taken on, by the cells that are labels too, and labels of labels, so
    that the number of passes grows with the logarithm of the distance across a component.
    """
    if is_concrete(neighbors):
        with jax.ensure_compile_time_eval():
            return _components_of(jnp.asarray(neighbors))
    return _components_of(neighbors)


@jax.jit
def _components_of(neighbors: Array) -> Array:
    count = neighbors.shape[0]
    own = jnp.arange(count, dtype=jnp.int32)
    other = jnp.clip(packing.cell_of(neighbors), 0, count - 1)
    other = jnp.where(neighbors >= 0, other, own[:, None])

    def spread(loop: tuple[Array, Array]) -> tuple[Array, Array]:
        label, _ = loop
        lowest = jnp.minimum(label, label[other].min(1))
        new = jnp.minimum(label.at[label].min(lowest), lowest)
        new = new[new]
        return new, jnp.any(new != label)

    return lax.while_loop(lambda loop: loop[1], spread, (own, jnp.asarray(True)))[0]


def _is_closed(mesh: Any) -> Array:
    """Whether () the faces of the boundary, as `entry` bits orient them, pass each edge as often in
    one direction as in the other: then the bits fit each other, at least within each component.

    Edges are added up as random numbers, forwards and with a minus backwards; a sum of 0 in 32 bits
    has a chance of 2^-32 otherwise.
    """
    rows, words = _welded(mesh.cells, mesh.duplicates, mesh.points.shape[0]), mesh.boundary
    a, b, c = outer_faces(rows, words, jnp).T
    total = _noise(a, b) + _noise(b, c) - _noise(a, c)
    total = jnp.where(packing.flag_of(words) == 1, -total, total)
    return jnp.sum(total, dtype=jnp.uint32) == 0


def _noise(i: Array, j: Array) -> Array:
    """Numbers (...) uint32 that look random, of pairs of integers: the finaliser of MurmurHash3."""
    x = i.astype(jnp.uint32) * np.uint32(0x9E3779B1) ^ j.astype(jnp.uint32)
    for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35)):
        x = (x ^ (x >> shift)) * np.uint32(factor)
        x = x + j.astype(jnp.uint32) * np.uint32(0x27D4EB2F)
    return x ^ (x >> 16)


def _welded(cells: Array, duplicates: Array, n_points: int) -> Array:
    """Rows (T, 4) with the welded ids of their points."""
    if not len(duplicates):
        return cells
    welded = jnp.arange(n_points, dtype=jnp.int32).at[duplicates[:, 0]].set(duplicates[:, 1])
    return welded[jnp.clip(cells, 0, n_points - 1)]


def _fits(
    n_points: int, cells: Array, neighbors: Array, boundary: Array, duplicates: Array
) -> Array:
    """Whether () the rules of `_require_connectivity` hold."""
    count = cells.shape[0]
    good = jnp.all((cells >= 0) & (cells < n_points))
    good &= jnp.all((duplicates >= 0) & (duplicates < n_points))
    rows = _welded(cells, duplicates, n_points)
    good &= jnp.all(rows[:, 1:] > rows[:, :-1])
    good &= jnp.all((neighbors >= -1) & (packing.cell_of(neighbors) < count))
    joined = neighbors >= 0
    cell = jnp.clip(packing.cell_of(neighbors), 0, count - 1)
    corner = packing.corner_of(neighbors)
    back = neighbors[cell, corner]
    here = jnp.arange(count, dtype=jnp.int32)[:, None], jnp.arange(4, dtype=jnp.int32)[None]
    good &= jnp.all(
        ~joined | (packing.cell_of(back) == here[0]) & (packing.corner_of(back) == here[1])
    )
    faces = jnp.asarray(FACES)
    there = cell[..., None], faces[corner]
    good &= jnp.all(~joined[..., None] | (rows[there] == rows[:, faces]))
    # Without coincident points ids agree wherever faces do.
    seam = jnp.any(cells[there] != cells[:, faces], axis=-1) if len(duplicates) else False
    good &= jnp.all(~joined | (packing.flag_of(neighbors) == seam))
    # Each face without a neighbour has one word, which is the one that names the cell there.
    good &= jnp.all((boundary >= 0) & (packing.cell_of(boundary) < count))
    at = jnp.clip(packing.cell_of(boundary), 0, count - 1), packing.corner_of(boundary)
    times = jnp.zeros((count, 4), jnp.int32).at[at].add(1)
    good &= jnp.all(times == ~joined)
    turned = packing.turned_of(jnp.where(joined, back, 0).at[at].max(boundary))
    return good & jnp.all(turned == turned[:, :1])


def _require_kinds(mesh: Any) -> None:
    for name in ("cells", "neighbors", "boundary", "duplicates"):
        x = getattr(mesh, name)
        # Compiled loops read 32 bits, whatever the array holds.
        if x.dtype != np.int32:
            raise ValueError(
                f"mesh.{name} must hold integers (int32), but has dtype {x.dtype}. {_ADVICE}"
            )
    for name in ("points", "values"):
        dtype = np.dtype(getattr(mesh, name).dtype)
        if dtype not in (np.float32, np.float64) or dtype != mesh.points.dtype:
            raise ValueError(
                f"mesh.{name} has dtype {dtype}; points and values must have the same, float32 or "
                "float64. mesh.replace(...) casts to that of the points."
            )
    count, points = mesh.cells.shape[0], mesh.points.shape[0]
    values = {"point": (points,), "cell": (count,), "corner": (count, 4)}[mesh.location]
    wanted = {
        "points": (points, 3),
        "values": values,
        "cells": (count, 4),
        "neighbors": (count, 4),
        "boundary": mesh.boundary.shape[:1],
        "duplicates": (*mesh.duplicates.shape[:1], 2),
    }
    for name, shape in wanted.items():
        if getattr(mesh, name).shape != shape:
            found = getattr(mesh, name).shape
            raise ValueError(f"mesh.{name} must have shape {shape}, but has {found}. {_ADVICE}")


def _require(good: np.ndarray, name: str, numbers: np.ndarray, what: str) -> None:
    if not good.all():
        first = tuple(int(i) for i in np.argwhere(~good)[0])
        raise ValueError(
            f"mesh.{name} is not that of a mesh: {int((~good).sum())} entries {what}, the first at "
            f"{first}: {numbers[first]}. {_ADVICE}"
        )


def _require_connectivity(
    cells: np.ndarray,
    neighbors: np.ndarray,
    boundary: np.ndarray,
    duplicates: np.ndarray,
    n_points: int,
) -> None:
    count = len(cells)
    if count == 0:
        raise ValueError("The mesh has no cells.")
    named = f"name none of the {n_points} points"
    _require((cells >= 0) & (cells < n_points), "cells", cells, named)
    _require((duplicates >= 0) & (duplicates < n_points), "duplicates", duplicates, named)
    welded = np.arange(n_points)
    welded[duplicates[:, 0]] = duplicates[:, 1]
    rows = welded[cells]
    ordered = np.diff(rows, axis=1) > 0
    _require(ordered, "cells", cells[:, 1:], "are not in the order of welded points")
    inside = (neighbors >= 0) & (packing.cell_of(neighbors) < count)
    none = f"name none of the {count} cells"
    _require(inside | (neighbors == -1), "neighbors", neighbors, none)
    there = np.maximum(packing.cell_of(neighbors), 0), packing.corner_of(neighbors)
    back = neighbors[there]
    here = np.arange(count)[:, None], np.arange(4)[None]
    returned = (packing.cell_of(back) == here[0]) & (packing.corner_of(back) == here[1])
    own = rows[:, FACES]
    shared = (rows[there[0][..., None], FACES[there[1]]] == own).all(-1)
    joined = (returned & shared) | (neighbors == -1)
    _require(joined, "neighbors", neighbors, "name a cell that does not have the face")
    known = (boundary >= 0) & (packing.cell_of(boundary) < count)
    _require(known, "boundary", boundary, none)
    outside = packing.cell_of(boundary), packing.corner_of(boundary)
    _require(neighbors[outside] == -1, "boundary", boundary, "name a face with a neighbour")
    open_faces = int((neighbors == -1).sum())
    if len(np.unique(4 * outside[0].astype(np.int64) + outside[1])) != open_faces:
        raise ValueError(
            f"mesh.boundary is not that of a mesh: it does not have each of the {open_faces} faces "
            f"without a neighbour. {_ADVICE}"
        )
    _require_bits(cells, neighbors, boundary)


def _require_bits(cells: np.ndarray, neighbors: np.ndarray, boundary: np.ndarray) -> None:
    """For integers that fit each other but for their bits."""
    joined = neighbors >= 0
    there = np.maximum(packing.cell_of(neighbors), 0), packing.corner_of(neighbors)
    seam = (cells[there[0][..., None], FACES[there[1]]] != cells[:, FACES]).any(-1)
    right = ~joined | (packing.flag_of(neighbors) == seam)
    _require(right, "neighbors", neighbors, "have a seam bit that ids deny")
    naming = np.where(joined, neighbors[there], 0)  # the four words that name each cell
    naming[packing.cell_of(boundary), packing.corner_of(boundary)] = boundary
    turned = packing.turned_of(naming)
    alike = turned == turned[:, :1]
    _require(alike, "neighbors", neighbors, "are of a cell that some call turned and some do not")
    agree = entries_agree(neighbors, boundary)
    _require(agree, "boundary", boundary, "have an entry bit that others in the component deny")
