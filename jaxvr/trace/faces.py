"""The faces of a mesh, each once, without a table of them.

Slot 4 c + k is the face of cell c opposite its local vertex k. A face between two cells belongs to
the cell of the lower number; the other's slot is empty. So nothing is stored that the mesh does not
have, and boxes round blocks of cells and a byte a cell are all that is computed beforehand.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core.gather import take
from jaxvr._core.pytree import pytree
from jaxvr.trace.scene import Scene, coordinates_of, entry_corners
from jaxvr.trace.select import BLOCK
from jaxvr.volume import packing

Array = jax.Array

CELLS = BLOCK // 4


@pytree
class CellFaces:
    """A `FaceSource` over a scene. boxes: low and high corners (3, blocks). marks (T,) int8: bit 0
    if the cell is `turned` (see `packing`), and bit 1, of cells at the boundary, tau (see
    `TetMesh.boundary`)."""

    scene: Scene
    boxes: tuple[Array, Array]
    marks: Array

    @property
    def vertices(self) -> Array:
        return self.scene.vertices

    def look(self, blocks: Array) -> tuple[Array, tuple[Array, Array, Array], Array]:
        count = self.scene.cells.shape[0] // 4
        cell = (blocks[:, None] * CELLS + jnp.arange(CELLS, dtype=jnp.int32)[None]).reshape(-1)
        there, cell = cell < count, jnp.minimum(cell, count - 1)
        # One row for each local vertex, and for the face opposite it.
        slot = 4 * cell[None] + jnp.arange(4, dtype=jnp.int32)[:, None]
        word = take(self.scene.neighbors, slot)
        mine = (word < 0) | (packing.cell_of(word) > cell[None])
        ids = take(self.scene.cells, slot)
        points = coordinates_of(self.vertices, ids)
        faces = [[j for j in range(4) if j != k] for k in range(4)]
        a, b, c = (
            jnp.concatenate([points[:, face[i]] for face in faces], axis=1) for i in range(3)
        )
        return slot.reshape(-1), (a, b, c), (there[None] & mine).reshape(-1)

    def corners(self, slot: Array) -> Array:
        cell, corner = slot // 4, slot % 4
        return take(self.scene.cells, 4 * cell[None] + entry_corners(corner))

    def keep(self, origin: Array, slot: Array) -> Array:
        """The faces of cells that may contain the eye: a segment that starts there needs its cell's
        other end too, behind the eye."""
        low, high = self.boxes
        near = jnp.all((origin >= low.min(1)) & (origin <= high.max(1)))

        def inside(slot):
            word = take(self.scene.neighbors, slot)
            behind = jnp.where(word < 0, slot // 4, packing.cell_of(word))
            return self._round(origin, slot // 4) | self._round(origin, behind)

        return lax.cond(near, inside, lambda slot: jnp.zeros(slot.shape, bool), slot)

    def turned(self, cell: Array) -> Array:
        """`turned` (N,) of cells, as an int32."""
        return take(self.marks, cell).astype(jnp.int32) & 1

    def inwards(self, slot: Array) -> Array:
        """The flag `entry` of `TetMesh.boundary` for slots (N,) at the boundary."""
        tau = (take(self.marks, slot // 4) & 2) != 0
        return tau == (slot % 2 == 1)

    def _round(self, origin: Array, cell: Array) -> Array:
        """Whether the boxes of cells (N,) contain a point (3,)."""
        ids = take(self.scene.cells, 4 * cell[None] + jnp.arange(4, dtype=jnp.int32)[:, None])
        points = coordinates_of(self.vertices, ids)
        eye = origin[:, None]
        return jnp.all((points.min(1) <= eye) & (points.max(1) >= eye), axis=0)


def cell_faces(scene: Scene) -> CellFaces:
    cells = scene.cells.shape[0] // 4
    blocks = -(-cells // CELLS)
    number = jnp.minimum(jnp.arange(blocks * CELLS), cells - 1)  # the last block is filled up
    ids = take(scene.cells.reshape(-1, 4), number)
    count = scene.coordinates.shape[0] // 3
    points = lax.stop_gradient(scene.coordinates).reshape(3, count)[:, ids.reshape(blocks, -1)]
    return CellFaces(scene, (points.min(2), points.max(2)), _marks(scene))


def _marks(scene: Scene) -> Array:
    words = scene.neighbors.reshape(-1, 4)
    # A neighbour's word for the way back says how this cell lies.
    side = jnp.argmax(words >= 0, axis=1)
    word = jnp.take_along_axis(words, side[:, None], axis=1)[:, 0]
    back = scene.neighbors.at[4 * packing.cell_of(word) + packing.corner_of(word)].get(mode="clip")
    turned = jnp.where(word >= 0, packing.turned_of(back), 0).astype(jnp.int8)
    face = scene.faces
    cell = jnp.where(face >= 0, packing.cell_of(face), words.shape[0])
    tau = packing.flag_of(face) == packing.corner_of(face) % 2
    mark = packing.turned_of(face) | jnp.where(tau, 2, 0)
    return turned.at[cell].set(mark.astype(jnp.int8), mode="drop")
