"""An exact visibility order of a mesh's faces for one view: for comparison, on the host.

Two cells that share a face are in order: the one on the eye's side of the face comes first. Cells
sorted topologically by these relations are in visibility order if the mesh is convex and has no
cycles (MPVO: Williams, "Visibility ordering meshed polyhedra", 1992).
Where a mesh is not convex, a ray leaves it and enters it again, and then the cell of the exit comes
before that of the entry (SXMPVO: Cook, Max, Silva and Williams, "Image-space visibility ordering
for cell projection volume rendering of unstructured data", 2004; see `order.gaps`).

Here

- faces seen edge-on, to within rounding in float64, relate nothing, and cells that lie the wrong
  way round among their neighbours (folds) count as the right way round, as on a walk: rays go
  through them backwards, so there the order is that of the cells and depths are not sorted. So do
  cells without volume, and cells that moved points have turned over.
- cells are not drawn but their faces are. A face goes with the cell behind it, an exit after its
  cell. Along a ray cells grow in rank, and so do its faces.

The sort goes by levels (Kahn 1962): all cells that wait for nobody, all that waited only for these,
and so on. Cells that wait for each other, or for such, are left over. Among them strongly connected
components are found, the cell with the nearest centroid in each stops waiting for others of its
component, and so on until there are none: all relations that do not belong to a cycle hold.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from jaxvr._core.checks import is_concrete
from jaxvr.order.gaps import View, across_gaps, expand, look
from jaxvr.order.keys import AbstractOrder
from jaxvr.view import Camera
from jaxvr.volume import TetMesh, packing
from jaxvr.volume.connectivity import FACES, orientations
from jaxvr.volume.integrity import require_mesh

_CELLS = 1 << 18  # at once, where sides are found
_BOUND = 16 * 2.0**-53  # orient3d (see `volume.geometry`) and the rounding of a direction of view
_PASSES = 64  # after which what is left of cycles goes by centroid


@dataclasses.dataclass(frozen=True, eq=False)
class ExactOrder(AbstractOrder):
    """Faces of one mesh in visibility order for one camera. Make one with `exact_order`.

    table (4T,) int32: key of slot 4c + k, the face of cell c opposite its local vertex k; the two
        slots of an inner face have the same. 2 rank(cell behind it), or 2 rank(cell) + 1 for faces
        with nothing behind them.
    cycles: how many cells come before one that should come before them, because of cycles.
    levels: of the topological sort.

    Compared and hashed by identity, so that it can be a static argument.
    """

    table: np.ndarray = dataclasses.field(repr=False)
    cycles: int
    levels: int

    def keys(self, faces):
        """As in the table: float32 would not tell them apart above 2**24, or 8 million cells."""
        return jnp.asarray(self.table)[faces.slot]


def exact_order(mesh: TetMesh, camera: Camera) -> ExactOrder:
    """The order in which the camera's rays, one a pixel, meet the faces of the mesh.

    Every pixel's fragments come sorted by depth, but for cycles, folds, parts of the mesh that
    overlap, and faces in whose plane the eye lies (and then only those at the eye itself). In
    float64, whatever the mesh's dtype, and on the host: not for use inside `jit`. Takes about a
    second for a million cells, and two for a million fragments of the boundary.
    """
    if not isinstance(mesh, TetMesh):
        raise ValueError(
            f"exact_order orders the faces of a TetMesh, not of a {type(mesh).__name__}."
        )
    if not isinstance(camera, Camera):
        raise ValueError(
            f"exact_order needs one Camera, not a {type(camera).__name__}: call it for each view."
        )
    if not is_concrete(*jax.tree.leaves((mesh, camera))):
        raise ValueError("exact_order needs to know the numbers: call it outside of jit and grad.")
    require_mesh(mesh)
    cells, words = np.asarray(mesh.cells), np.asarray(mesh.neighbors)
    view = look(mesh, camera)
    tau = orientations(words, np.asarray(mesh.boundary))[0]
    side = _sides(view, cells, words, tau)
    front, k = np.nonzero((side > 0) & (words >= 0))
    back = packing.cell_of(words[front, k])
    exits, entries = across_gaps(view, mesh, float(np.finfo(mesh.dtype).eps))
    before = np.concatenate([front, exits]).astype(np.int32)
    after = np.concatenate([back, entries]).astype(np.int32)
    rank, levels = _sort(view, cells, before, after)
    cycles = len(np.unique(after[rank[before] > rank[after]]))
    return ExactOrder(_table(rank, side, words), cycles, levels)


def _table(rank: np.ndarray, side: np.ndarray, words: np.ndarray) -> np.ndarray:
    own = np.broadcast_to(rank[:, None], words.shape)
    other = np.where(words < 0, own, rank[packing.cell_of(words)])
    behind = np.where(side > 0, other, np.where(side < 0, own, np.maximum(own, other)))
    last = (words < 0) & (side >= 0)
    return (2 * behind + last).astype(np.int32).reshape(-1)


def _sides(view: View, cells: np.ndarray, words: np.ndarray, tau: np.ndarray) -> np.ndarray:
    """Whether a cell is on the eye's side of its face: (T, 4) int8, 1 if so, -1 if it is behind,
    0 if the face is seen edge-on.

    With the face's vertices a, b, c in the order of the row, det(b - a, c - a, q - a) has the sign
    (-1)**(3 - k) tau for q = vertex k, which is moved to the row's end by 3 - k swaps; for q = eye
    it says where that is. Each inner face is looked at once, so that its cells agree.
    """
    side = np.zeros(cells.shape, np.int8)
    for start in range(0, len(cells), _CELLS):
        chunk, word = cells[start : start + _CELLS], words[start : start + _CELLS]
        number = np.arange(start, start + len(chunk))
        for k in range(4):
            first = (word[:, k] < 0) | (packing.cell_of(word[:, k]) > number)
            c = number[first]
            eye = _eye_side(view, chunk[first][:, FACES[k]])
            side[c, k] = eye * tau[c] * (1 if k % 2 else -1)
            inner = word[first, k] >= 0
            n = word[first, k][inner]
            side[packing.cell_of(n), packing.corner_of(n)] = -side[c[inner], k]
    return side


def _eye_side(view: View, faces: np.ndarray) -> np.ndarray:
    """The sign (N,) int8 of det(b - a, c - a, eye - a) for faces (N, 3), 0 within its rounding."""
    a, b, c = (view.points[faces[:, i]].T for i in range(3))
    if view.towards is None:
        x, y, z = view.eye[:, None] - a
    else:
        x, y, z = view.towards
    (ux, uy, uz), (vx, vy, vz) = b - a, c - a
    det = x * (uy * vz - uz * vy) + y * (uz * vx - ux * vz) + z * (ux * vy - uy * vx)
    size = (
        abs(x) * (abs(uy * vz) + abs(uz * vy))
        + abs(y) * (abs(uz * vx) + abs(ux * vz))
        + abs(z) * (abs(ux * vy) + abs(uy * vx))
    )
    return np.where(abs(det) <= _BOUND * size, 0, np.sign(det)).astype(np.int8)


def _sort(
    view: View, cells: np.ndarray, before: np.ndarray, after: np.ndarray
) -> tuple[np.ndarray, int]:
    """Ranks (T,) of cells, so that `before` (E,) ranks lower than `after` but for cycles, and the
    number of levels."""
    rank = np.full(len(cells), -1)
    levels = _levels(rank, before, after)
    if (rank < 0).any():
        left = rank[before] < 0  # so is what comes after
        before, after = before[left], after[left]
        centroids = view.points[cells].mean(1)
        if view.towards is None:
            distance = ((centroids - view.eye) ** 2).sum(1)
        else:
            distance = -(centroids @ view.towards)
        keep = _without_cycles(distance, before, after)
        levels += _levels(rank, before[keep], after[keep])
    return rank, levels


def _levels(rank: np.ndarray, before: np.ndarray, after: np.ndarray) -> int:
    """Ranks cells that have none, level by level, as far as there are no cycles."""
    from scipy.sparse import coo_matrix  # here, since it takes a while to import

    n = len(rank)
    graph = coo_matrix((np.ones(len(before), np.int8), (before, after)), shape=(n, n)).tocsr()
    waits = np.bincount(graph.indices, minlength=n)
    level = np.flatnonzero((waits == 0) & (rank < 0))
    placed, levels = int((rank >= 0).sum()), 0
    while len(level):
        rank[level] = np.arange(placed, placed + len(level))
        placed, levels = placed + len(level), levels + 1
        start = graph.indptr[level]
        which, number = expand(graph.indptr[level + 1] - start)
        later = graph.indices[start[which] + number]
        np.subtract.at(waits, later, 1)
        level = np.unique(later[waits[later] == 0])
    return levels


def _without_cycles(distance: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Which relations (E,) to keep so that no cycle is left; see the module."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    keep = np.ones(len(before), bool)
    live = np.arange(len(before))
    for _ in range(_PASSES):
        nodes, ends = np.unique(np.stack([before[live], after[live]]), return_inverse=True)
        ends = ends.reshape(2, -1)
        graph = coo_matrix((np.ones(len(live), np.int8), tuple(ends)), shape=(len(nodes),) * 2)
        label = connected_components(graph, directed=True, connection="strong")[1]
        inside = label[ends[0]] == label[ends[1]]  # a relation in a cycle has both ends in one
        live, ends = live[inside], ends[:, inside]
        if len(live) == 0:
            return keep
        order = np.lexsort((distance[nodes], label))
        nearest = np.zeros(len(nodes), bool)
        nearest[order[np.unique(label[order], return_index=True)[1]]] = True
        dropped = nearest[ends[1]]
        keep[live[dropped]] = False
        live = live[~dropped]
    order = np.empty(len(distance), np.int64)
    order[np.argsort(distance, kind="stable")] = np.arange(len(distance))
    keep[live[order[before[live]] > order[after[live]]]] = False
    return keep
