"""A heat sink: a finned block of all four cell types, and the steady heat equation on it."""

from __future__ import annotations

from typing import Any

import numpy as np

from . import fem
from .connectivity import FACES
from .mesh import TetMesh, _from_cells
from .packing import cell_of, corner_of
from .structured import grid_cells
from .unused import used_by

FIN, GAP = 0.4, 0.6  # widths across, cm
BASE, FIN_HEIGHT, DEPTH = 0.8, 2.4, 4.0  # cm
AMBIENT = 293.15  # K

_NONE, _HEX, _LEFT, _RIGHT, _MIXED = range(5)


def heat_sink(
    fins: int = 5,
    resolution: int = 2,
    conductivity: float = 2.0,
    convection: float = 0.05,
    power: float = 100.0,
    dtype: Any = None,
) -> TetMesh:
    """A heat sink on a hot chip, its values the temperature in kelvin, lengths in centimetres.

    fins: how many stand along x; y is up, z along the fins. resolution: cells across a fin, at
        least 2; the number of tetrahedra grows with its cube (23 thousand for the defaults).
    conductivity: W/(cm K); aluminium has about 2. convection: W/(cm^2 K), to air of 293.15 K, on
        fins and the top of the base. power: W, through a square chip in the middle of the bottom;
        the rest of the base is insulated.

    The base and the fins are hexahedra; the fins end in gables whose slopes are wedges; the top
    layer of the base, from which the fins grow, is of tetrahedra and pyramids round the centre of
    each block. The temperature solves the heat equation by linear finite elements on the very
    tetrahedra that are rendered (see `fem`).
    """
    if not isinstance(fins, (int, np.integer)) or fins < 1:
        raise ValueError(f"fins must be a positive integer, but is {fins}.")
    if not isinstance(resolution, (int, np.integer)) or resolution < 2:
        raise ValueError(f"resolution must be an integer of at least 2, but is {resolution}.")
    for name, x in (("conductivity", conductivity), ("convection", convection)):
        if not (0 < x < np.inf):
            raise ValueError(f"{name} must be positive and finite, but is {x}.")
    if not np.isfinite(power):
        raise ValueError(f"power must be finite, but is {power}.")
    points, cells = _mesh(int(fins), int(resolution))
    zero = np.zeros(len(points))
    bare = _from_cells(TetMesh, points, cells, zero, "point", dtype, "temperature", stacklevel=3)
    p = np.asarray(bare.points, np.float64)
    tets = np.asarray(bare.cells)
    words = np.asarray(bare.boundary)
    faces = tets[cell_of(words)[:, None], FACES[corner_of(words)]]
    centre = p[faces].mean(1)
    floor = p[faces][..., 1].min(1)
    cooled = faces[floor > BASE * (1 - 1e-5)]
    lo, hi = p.min(0), p.max(0)
    chip = np.abs(centre - (lo + hi) / 2)[:, [0, 2]].max(1) < 0.8
    heated = faces[chip & (p[faces][..., 1].max(1) < 1e-5)]
    flux = power / fem.measure(p, heated).sum()
    matrix = conductivity * fem.stiffness(p, tets) + fem.mass(p, cooled, convection)
    rise = fem.solve(matrix, fem.load(p, heated, flux))
    return bare.replace(values=AMBIENT + rise)


def _layout(fins: int, r: int) -> tuple[np.ndarray, int]:
    """What stands in each place of a lattice [x, y, z], and how many layers the base has."""
    gap = max(1, round(r * GAP / FIN))
    base = max(2, round(r * BASE / FIN))
    height = round(r * FIN_HEIGHT / FIN)
    gable = r // 2
    kind = np.full((fins * (r + gap) - gap, base + height + gable, 8 * r), _NONE)
    kind[:, : base - 1] = _HEX
    kind[:, base - 1] = _MIXED
    for left in range(0, kind.shape[0], r + gap):
        kind[left : left + r, base : base + height] = _HEX
        for step in range(gable):
            y = base + height + step
            kind[left + step, y] = _LEFT
            kind[left + step + 1 : left + r - step - 1, y] = _HEX
            kind[left + r - step - 1, y] = _RIGHT
    return kind, base


def _mesh(fins: int, r: int) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    kind, base = _layout(fins, r)
    nx, ny, nz = kind.shape
    step = FIN / r
    # the base's layers fill its height exactly, whatever the rounding
    y = np.r_[np.linspace(0, BASE, base + 1), BASE + step * np.arange(1, ny - base + 1)]
    zz, yy, xx = np.meshgrid(
        np.linspace(0, DEPTH, nz + 1), y, step * np.arange(nx + 1), indexing="ij"
    )
    points = np.stack([xx.ravel(), yy.ravel(), zz.ravel()], 1)
    lattice = grid_cells(nx + 1, ny + 1, nz + 1)
    flat = kind.transpose(2, 1, 0).ravel()
    cells = {"hexahedron": lattice[flat == _HEX]}
    # corners 0 1 5 4 lie at the bottom, 3 2 6 7 above them
    left, right = lattice[flat == _LEFT], lattice[flat == _RIGHT]
    cells["wedge"] = np.concatenate([left[:, [0, 2, 1, 4, 6, 5]], right[:, [0, 3, 1, 4, 7, 5]]])
    points, cells["pyramid"], cells["tetra"] = _mixed(points, lattice[flat == _MIXED])
    used = used_by(len(points), *cells.values())
    number = np.cumsum(used) - 1
    return points[used], {t: number[c] for t, c in cells.items()}


def _mixed(points: np.ndarray, blocks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Blocks cut round a new centre point: pyramids on the bottom and top, tetrahedra on the sides.

    A side is cut along the diagonal from its smallest vertex, as every quadrilateral is, so both
    blocks that share it cut it alike.
    """
    centre = len(points) + np.arange(len(blocks))
    points = np.concatenate([points, points[blocks].mean(1)])
    bottom, top = blocks[:, [0, 1, 5, 4]], blocks[:, [3, 7, 6, 2]]
    pyramids = np.concatenate([bottom, top])
    # each base is listed so that the apex lies on the positive side
    pyramids = np.c_[pyramids[:, ::-1], np.tile(centre, 2)]
    sides = [[0, 1, 2, 3], [4, 7, 6, 5], [0, 3, 7, 4], [1, 5, 6, 2]]
    tets = []
    for side in sides:
        q = blocks[:, side]
        first = q.argmin(1)
        q = np.take_along_axis(q, (first[:, None] + np.arange(4)) % 4, 1)
        tets += [np.c_[q[:, [0, 1, 2]], centre], np.c_[q[:, [0, 2, 3]], centre]]
    return points, pyramids, np.concatenate(tets)
