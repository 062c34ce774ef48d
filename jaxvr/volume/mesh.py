"""The unstructured volume: tetrahedra, a scalar on them, and how they hang together."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from .._core.checks import as_floats, is_concrete, require_finite, require_shape
from .._core.offsets import (
    NOWHERE,
    Origin,
    absolute,
    added,
    digits_of,
    is_single,
    offset_of,
    origin_between,
    origin_of,
    require_said,
    said,
)
from .._core.pytree import pytree, static
from . import integrity, statistics
from .base import AbstractVolume
from .build import build, require_sound
from .digits import coarse_cells
from .integrity import require_connectivity, trust, trust_entries
from .mirror import mirrored
from .report import MeshReport, coarse_warning
from .values import choose_location, less_offset, place

if TYPE_CHECKING:
    from jaxvr.trace.base import AbstractTracer

Array = jax.Array


@pytree
class TetMesh(AbstractVolume):
    """Tetrahedra with a scalar field. Make one with `TetMesh.from_cells` or `jaxvr.read_mesh`.

    points (P, 3): relative to `origin`; points that coincide are kept apart.
    values (P,), (T,) or (T, 4): relative to `offset`; by `location`, "point", "cell" or "corner"
        (the corners in the order of `cells`); the dtype is that of points.
    cells (T, 4) int32: point ids. Each row is sorted by *welded* id, the smallest index among
        points that coincide exactly; the four are distinct. So a face that two cells share lists
        its vertices in the same order in both, and rows are not sorted by orientation.
    neighbors (T, 4) int32: entry k is what lies across the face opposite local vertex k: -1 for
        nothing, else a word (see `packing`): the neighbouring cell; which local vertex of it lies
        opposite the face; `turned`, set where the neighbouring cell lies the wrong way round; and
        the flag `seam`, set where the two cells use different, coincident points for the face.
    boundary (F,) int32: a word for each face without a neighbour: cell, the local vertex f that
        it omits, `turned` of this cell, and the flag `entry`: whether sigma > 0, where tau = 1 if
        the row (as the mesh would be unfolded) is positively oriented, det(q1 - q0, q2 - q0,
        q3 - q0) > 0, else -1, and sigma = tau if f is odd else -tau. In Morton order.
    duplicates (n, 2) int32: every point that coincides with an earlier one, and its welded id.
    location, report: static.
    origin (3,), offset: plain numbers, static. 0 but in float32 for points, or values, far from 0
        and close together, of which it would keep too few digits (coordinates in a national grid,
        101325 Pa and a few more): these are taken off in float64 before anything is rounded.
        `absolute_points` and `absolute_values` put them back; cameras, rays, transfer functions
        and probes take and give the world's numbers, and know of both.

    A cell is turned if its geometric orientation contradicts that of its neighbours, so that it
    overlaps them (a fold, as in a crushed mesh). The bit says how the cell lies in the mesh *as it
    was built*: `replace(points=...)` keeps it, so it is right for moves that turn no cell over and
    keep coincident points together; after larger ones, build the mesh anew.

    Cells may have no volume, or none beyond the rounding of their points: they keep the faces
    beside them from being boundaries, and a ray passes them in no length. The same goes for cells
    that moved points turn over: a ray waits in them where it is, until it gets farther again.
    """

    lengths: ClassVar[tuple[str, ...]] = ("points",)
    scalars: ClassVar[tuple[str, ...]] = ("values",)

    points: Array
    values: Array
    cells: Array
    neighbors: Array
    boundary: Array
    duplicates: Array
    location: str = static(default="point")
    report: MeshReport = static(default=MeshReport())
    origin: Origin = static(default=NOWHERE)
    offset: float = static(default=0.0)

    @classmethod
    def from_cells(
        cls,
        points: Any,
        cells: Mapping[Any, Any],
        values: Any,
        *,
        location: str | None = None,
        dtype: Any = None,
    ) -> TetMesh:
        """A mesh from any mix of tetrahedra, hexahedra, wedges and pyramids.

        points (P, 3): coordinates.
        cells: from cell type to point ids (N, n). Types go by meshio's names ("tetra",
            "hexahedron", "wedge", "pyramid"), VTK's names or numbers; nodes in VTK's order (for
            wedges meshio's is as good). Quadratic cells are reduced to their corners; points, lines
            and faces are ignored; the report counts both.
        values: (P,) for points; (N,) for the given cells, in the order of the blocks, or a dict
            from type to (n,); (N, 4) for corners, where all cells are tetra.
        location: "point", "cell" or "corner"; `None` takes the one whose shape fits.
        dtype: float32 or float64; `None` takes float64 if x64 is on and points are, else float32.

        Zoo cells are cut into tetrahedra that conform (see `cells`). Tetrahedra that have a point
        twice (by `weld`) are dropped, those without volume kept, since they close cracks, and
        inverted ones turned round, with one warning that counts all three. Flat ones because of
        which a face would have three cells are dropped, too.

        Raises ValueError for arrays of the wrong shape or kind, indices out of range, NaN or
        infinite numbers, an unknown cell type, cells that are mostly twisted as their nodes are in
        another order, faces with three or more cells, cells given twice, values that fit nothing or
        more than one location, and where no cells are left. Warns of integer values that float32
        cannot hold, and of points and values of which it keeps too few digits in spite of an
        `origin` and an `offset`.
        """
        return _from_cells(cls, points, cells, values, location, dtype, None, stacklevel=3)

    @classmethod
    def from_pyvista(
        cls, grid: Any, field: str | None = None, *, location: str | None = None, dtype: Any = None
    ) -> TetMesh:
        """A mesh from a grid of PyVista or VTK: unstructured, structured, rectilinear, image data.

        field, location, dtype: as in `jaxvr.read_mesh`; `None` takes the grid's active scalars if
            they have one component, else its first scalar field, point fields before cell fields.

        Zoo cells are subdivided as in `from_cells`; cells that VTK does not draw (blanked or ghost
        cells) are left out. Nothing is shared with the grid. Raises ValueError for anything that is
        no grid, has no such field (with those it has), or fails `from_cells`.
        """
        from .vtk_grid import read_grid

        return read_grid(cls, grid, field, location, dtype)

    def to_pyvista(self) -> Any:
        """A pyvista.UnstructuredGrid of the tetrahedra (positively oriented), its field active.

        The field has the name it was read by, or "values". Corner data becomes point data on points
        of each tetrahedron's own; `from_pyvista` welds those, so faces and pictures are the same.
        Needs PyVista: `pip install pyvista`.
        """
        from .vtk_grid import write_grid

        return write_grid(self)

    def replace(
        self,
        *,
        values: Any = None,
        points: Any = None,
        location: Any = None,
        origin: Any = None,
        offset: Any = None,
    ) -> TetMesh:
        """The same connectivity with new floats; works under `jit` and `grad`.

        values: of the shape of any location, (P,), (T,) or (T, 4); where two fit, the present
        location is kept, or `location` says which. points (P, 3): see the class on what may move.
        Both are cast to the dtype of the points. origin, offset: what the new points, or values,
        are relative to: 0 for numbers as they are, `mesh.origin` or `mesh.offset` for what was made
        of the mesh's own. To be said where the mesh has one. Numbers of float64 far from 0 are held
        relative to another one, as in `from_cells`; JAX's float32 and what is traced stay as they
        are. Raises ValueError for other shapes and, outside tracing, for NaN or infinite entries.
        Warns, also outside only, of lost digits as `from_cells` does.

        Points that mirror the mesh (an axis with another sign, two axes swapped), or a part of it
        that hangs together, turn all cells over: outside tracing its `entry` bits go with it. Where
        more than a quarter of the volume at the boundary is turned over without that, a warning
        says how many cells are. Inside tracing the bits stay: there a mesh of which a component is
        mirrored ends in a status, or in a picture of NaN.
        """
        new: dict[str, Any] = {}
        looked = False
        if points is not None:
            new["points"], new["origin"] = self._points(points, origin)
            require_shape("points", new["points"], self.points.shape)
            if is_concrete(new["points"], self.cells, self.neighbors, self.boundary):
                require_connectivity(self)
                found, message = mirrored(new["points"], self.cells, self.neighbors, self.boundary)
                if found is not None:
                    new["boundary"] = jnp.asarray(found)
                looked = True
                if message:
                    warnings.warn(message, UserWarning, stacklevel=2)
        if values is not None:
            v, new["offset"] = self._values(values, offset)
            sizes = {"point": (self.n_points,), "cell": (self.n_tets,), "corner": self.cells.shape}
            if location is None and v.shape == sizes[self.location]:
                location = self.location
            new["values"] = v
            new["location"] = choose_location(v.shape, sizes, location)
        elif location is not None:
            raise ValueError("location says where values live: pass values too.")
        for name, of in (("origin", points), ("offset", values)):
            if of is None and {"origin": origin, "offset": offset}[name] is not None:
                numbers = "points" if name == "origin" else "values"
                raise ValueError(f"{name} says what {numbers} are relative to: pass {numbers} too.")
        changed = dataclasses.replace(self, **new)
        return trust_entries(changed) if looked else changed

    def _points(self, points: Any, origin: Any) -> tuple[Array, Origin]:
        """New points as they are held, and what they are relative to."""
        if origin is None:
            require_said("points", "origin", self.origin)
        place = NOWHERE if origin is None else origin_of(origin)
        points, given = digits_of(points), points
        wide = not isinstance(points, jax.Array)
        if not is_concrete(points) or np.shape(points) != self.points.shape:
            return self._floats("points", points), place
        exact = as_floats("points", np.asarray(points), dtype=np.float64)
        require_finite("points", exact)
        cells = np.asarray(self.cells) if is_concrete(self.cells) else None
        used = exact if cells is None else exact[statistics.used_points(self)]
        away = np.asarray(origin_between(used.min(axis=0), used.max(axis=0), self.dtype))
        if wide and (origin is None or not is_single(points)):
            place, away = added(place, away)
            points, exact = exact - away, exact - away
        held = self._floats("points", points)
        if cells is not None and is_concrete(held):  # under jit constants are not
            coarse = coarse_cells(given, exact, np.asarray(held), away, cells)
            if message := coarse_warning(coarse, self.n_tets):
                warnings.warn(message, UserWarning, stacklevel=3)
        return held, place

    def _values(self, values: Any, offset: Any) -> tuple[Array, float]:
        """New values as they are held, and what they are relative to."""
        if offset is None:
            require_said("values", "offset", self.offset)
        away = 0.0 if offset is None else offset_of(offset)
        values, given = digits_of(values), values
        if not is_concrete(values):
            return self._floats("values", values), away
        exact = as_floats("values", np.asarray(values), dtype=np.float64)
        require_finite("values", exact)
        used = exact.reshape(-1)
        if exact.shape == (self.n_points,) and is_concrete(self.cells):
            used = exact[statistics.used_points(self)]
        if used.size == 0:
            return self._floats("values", values), away
        more, message = less_offset(given, used, self.dtype)
        if message:
            warnings.warn(message, UserWarning, stacklevel=3)
        if not isinstance(values, jax.Array) and (offset is None or not is_single(values)):
            away, more = added(away, more)
            values = exact - more
        return self._floats("values", values), away

    def _floats(self, name: str, x: Any) -> Array:
        with np.errstate(over="ignore"):  # too large for the dtype is infinite, and found below
            out = as_floats(name, x, dtype=self.points.dtype)
        require_finite(name, out)  # looks only where the numbers are known
        return jnp.asarray(out)

    def absolute_points(self) -> np.ndarray:
        """The points (P, 3) in the world, float64: with the origin. Not inside `jit`."""
        return absolute(self.points, self.origin)

    def absolute_values(self) -> np.ndarray:
        """The values as the field has them, float64: with the offset. Not inside `jit`."""
        return absolute(self.values, self.offset)

    @property
    def dtype(self) -> np.dtype:
        """That of points and values."""
        return np.dtype(self.points.dtype)

    @property
    def n_points(self) -> int:
        """Number P of points."""
        return self.points.shape[0]

    @property
    def n_tets(self) -> int:
        """Number T of tetrahedra."""
        return self.cells.shape[0]

    @property
    def n_boundary(self) -> int:
        """Number F of faces without a neighbour."""
        return self.boundary.shape[0]

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays, on the device."""
        return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(self))

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper corner (3,) of the box round the points that cells use, relative to
        `origin` as these are."""
        used = self.points[self.cells.reshape(-1)]
        return used.min(axis=0), used.max(axis=0)

    def default_tracer(self) -> AbstractTracer:
        """`RayCast()`."""
        from jaxvr.trace import RayCast

        return RayCast()

    def require(self) -> None:
        integrity.require_mesh(self)

    def hold(self, bits: Array) -> Array:
        return integrity.hold(self, bits)

    def unasked(self, image: Array, bits: Array) -> Array:
        return integrity.unasked(self, image, bits)

    def in_range(self, compiled: bool) -> Array:
        return integrity.in_range(self, compiled)

    def value_range(self) -> tuple[float, float]:
        """The least and the largest value that a cell uses, with the offset."""
        return statistics.value_range(self)

    def weighted_values(self) -> tuple[np.ndarray, np.ndarray]:
        """See `jaxvr.volume.statistics.weighted_values`."""
        return statistics.weighted_values(self)

    def levels(self) -> np.ndarray | None:
        return self.absolute_values() if self.location == "cell" else None

    def hull(self) -> np.ndarray:
        """The points (P, 3) that cells use, float64."""
        return np.asarray(self.points, np.float64)[statistics.used_points(self)]

    def dots(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Middles, volumes and mean values of the cells."""
        return statistics.dots(self)

    def glance(self) -> tuple[Array | None, Array, Array]:
        # A point without a cell would widen the range of values. The box is of all points.
        return self.cells if self.location == "point" else None, self.values, self.points

    @property
    def parts(self) -> int:
        """Number of tetrahedra."""
        return self.n_tets

    @property
    def field_name(self) -> str:
        """What the scalar was called where it was read."""
        return self.report.field or ""

    def describe(self) -> str:
        """A page on the mesh for people: counts, repairs, components, boundary, box, quality,
        field and bytes. `print(mesh.describe())`."""
        from .describe import describe

        return describe(self)

    def __repr__(self) -> str:
        # leaves may be tracers or placeholders
        shape = getattr(self.cells, "shape", ("?",))
        points = getattr(self.points, "shape", ("?",))
        where = f", relative to {said(self.origin)}" if any(self.origin) else ""
        less = f" less {said(self.offset)}" if self.offset else ""
        return f"TetMesh({shape[0]} tets, {points[0]} points{where}, {self.location} data{less})"

    def _repr_html_(self) -> str | None:
        from .html import mesh_html

        return mesh_html(self)  # None: notebooks show the repr


def _from_cells(
    cls: type[TetMesh],
    points: Any,
    cells: Any,
    values: Any,
    location: str | None,
    dtype: Any,
    field: str | None,
    stacklevel: int,
    flat_before: bool = False,
    strict: bool = False,
    origin: Origin | None = None,
    offset: float | None = None,
) -> TetMesh:
    """flat_before: flat cells among these have been warned of. strict: the cells come from a file
    or another program, and repairs of more than a tenth of them are an error. origin, offset: what
    points and values are relative to already."""
    built = build(points, cells, dtype, field, origin)
    if strict:
        require_sound(built)
    placed, where, away, lost = place(values, built, location, offset)
    news = dataclasses.replace(built.report, flat=0) if flat_before else built.report
    coarse = coarse_warning(news.coarse, news.tets) if origin is None else None
    for message in (news.warning(), coarse, lost):
        if message:
            warnings.warn(message, UserWarning, stacklevel=stacklevel)
    return trust(
        cls(
            points=jnp.asarray(built.points),
            values=jnp.asarray(placed),
            cells=jnp.asarray(built.cells),
            neighbors=jnp.asarray(built.neighbors),
            boundary=jnp.asarray(built.boundary),
            duplicates=jnp.asarray(built.duplicates),
            location=where,
            report=built.report,
            origin=built.origin,
            offset=away,
        )
    )
