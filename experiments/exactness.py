"""How exact is rendering? Against brute force on real meshes, and the slab against its vectors.

    python experiments/exactness.py [--rays N] [--meshes bluntfin can ...] [--tiny] [--json FILE]

Each mesh is seen by rays of all kinds (`FAMILIES`) under a transfer function of eleven control
points with a peak and a jump, at an optical depth of about 3, and compared with the brute force of
`jaxvr.testing.brute`, which is given the same numbers: in float32 the points, scalars, rays and
transfer function as rounded to float32. Two sorts of ray are kept apart from the rest:

- *ambiguous* ones, for which the exact picture itself is discontinuous: they lie in the boundary
  (or, for cell data, between cells), so that a shift by `NUDGE` of the mesh's size changes the
  exact answer by more than the tolerance. Only rays that differ are examined for this.
- for meshes that intersect themselves (`can`) the order of cells is a matter of definition:
  brute force sorts all chords by depth, jaxvr composites paths whole. Alpha does not depend on it.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp

import jaxvr
from experiments.data import meshes_of, path_of
from jaxvr.testing.brute import BruteForce
from jaxvr.volume import read_mesh
from jaxvr.volume.connectivity import FACES

FIELDS = {
    "bluntfin": "density",
    "bluntfin_merged": "density",
    "oxygen_post": "speed",
    "disk_out_ref": "Temp",
    "can": "EQPS_node",
    "post_tets": None,
    "football_zoo": None,
    "cylinder_tets": None,
    "hexa_lattice": None,
}
TINY = ("football_zoo", "cylinder_tets")
FAMILIES = ("random", "vertices", "edges", "faces", "in_face", "on_vertex", "inside", "axis")
# In float32 a coordinate is rounded by 6e-8 of itself, a depth by as much of the eye's distance.
NUDGE = {"float64": 1e-13, "float32": 1e-7}
TOLERANCE = {"float64": 1e-10, "float32": 2e-5}


def transfer_function(values: Any, length: float, dtype: Any, depth: float = 3.0) -> Any:
    """Eleven control points: half evenly spread, half by quantile; a peak, a jump, and one point
    exactly at a vertex value."""
    values = np.sort(np.asarray(values, np.float64).ravel())
    share = np.linspace(0, 1, 11)
    even = values[0] + (values[-1] - values[0]) * share
    positions = 0.5 * even + 0.5 * np.quantile(values, share)
    positions[4] = values[np.searchsorted(values, positions[4])]
    positions = np.sort(positions)
    positions[8] = positions[7]
    colors = np.random.default_rng(11).random((11, 3))
    extinctions = np.array([0.2, 0.8, 0.4, 1.0, 0.6, 6.0, 0.5, 0.2, 1.6, 0.9, 1.2]) * depth / length
    parts = (np.asarray(x, dtype) for x in (positions, colors, extinctions))
    return jaxvr.TransferFunction(*parts)


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


def _inner_faces(mesh: Any) -> np.ndarray:
    """Corner numbers 4 c + k of faces (n, 3) that have a cell on either side."""
    cells = np.repeat(np.arange(mesh.n_tets), 4)
    omitted = np.tile(np.arange(4), mesh.n_tets)
    inner = np.asarray(mesh.neighbors).ravel() >= 0
    cells, omitted = cells[inner], omitted[inner]
    kept = FACES[omitted]
    return 4 * cells[:, None] + kept


def make_rays(
    mesh: Any, reference: BruteForce, family: str, count: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Origins and directions (count, 3) of a family, in the mesh's dtype.

    random: from a sphere of 1.5 diagonals round the mesh to points in its box. vertices, edges,
    faces: the same towards vertices, midpoints of edges, centres of faces. in_face: in the plane
    of an inner face, from one of its vertices (or from outside through it) through a point of the
    opposite edge. on_vertex: from a vertex, half of them to another vertex. inside: from points in
    cells. axis: along a coordinate axis, exactly through a vertex, from outside.
    """
    dtype = np.asarray(mesh.points).dtype
    corners = reference.corners.reshape(-1, 3)
    pick = corners[rng.integers(0, len(corners), count)]
    cell = reference.corners[rng.integers(0, len(reference.corners), count)]
    middle = 0.5 * (reference.low + reference.high)
    eye = middle + 1.5 * reference.diagonal * _unit(rng.normal(size=(count, 3)))
    towards = _unit(rng.normal(size=(count, 3)))
    if family == "random":
        target = reference.low + (reference.high - reference.low) * rng.random((count, 3))
        origins, directions = eye, target - eye
    elif family in ("vertices", "edges", "faces"):
        k = ("vertices", "edges", "faces").index(family) + 1
        origins, directions = eye, cell[:, :k].mean(1) - eye
    elif family == "in_face":
        faces = _inner_faces(mesh)
        a, b, c = np.moveaxis(corners[faces[rng.integers(0, len(faces), count)]], 1, 0)
        t = rng.random((count, 1))
        directions = b + t * (c - b) - a
        back = np.where(rng.random((count, 1)) < 0.5, 0.0, 1.5 * reference.diagonal)
        origins = a - back * _unit(directions)
    elif family == "on_vertex":
        origins = pick
        other = corners[rng.integers(0, len(corners), count)]
        same = (other == pick).all(1, keepdims=True)
        half = (np.arange(count) % 2 == 0)[:, None]
        directions = np.where(half & ~same, other - pick, towards)
    elif family == "inside":
        weight = rng.dirichlet(np.ones(4), count)
        origins, directions = (weight[..., None] * cell).sum(1), towards
    elif family == "axis":
        axis, sign = rng.integers(0, 3, count), np.where(rng.random(count) < 0.5, -1.0, 1.0)
        directions = np.eye(3)[axis] * sign[:, None]
        origins = pick.copy()
        at = np.arange(count)
        origins[at, axis] = (middle - sign[:, None] * reference.diagonal)[at, axis]
    else:
        raise ValueError(f"family must be one of {FAMILIES}, but is {family!r}.")
    return origins.astype(dtype), directions.astype(dtype)


def lattice_rays(mesh: Any, reference: BruteForce) -> tuple[np.ndarray, np.ndarray]:
    """Orthographic views along the six axis directions, pixel centres at every vertex of a lattice
    and half-way between them: rays in faces, along edges and through vertices."""
    points = np.asarray(mesh.points)
    origins, directions = [], []
    for axis in range(3):
        one, two = (axis + 1) % 3, (axis + 2) % 3
        lines = [np.unique(points[:, k]) for k in (one, two)]
        lines = [np.concatenate([g, ((g[1:] + g[:-1]) / 2).astype(g.dtype)]) for g in lines]
        u, v = np.meshgrid(*lines, indexing="ij")
        for sign in (-1, 1):
            o = np.zeros((u.size, 3))
            o[:, one], o[:, two] = u.ravel(), v.ravel()
            o[:, axis] = reference.low[axis] - sign * reference.diagonal
            if sign < 0:
                o[:, axis] = reference.high[axis] + reference.diagonal
            origins.append(o)
            directions.append(np.tile(sign * np.eye(3)[axis], (u.size, 1)))
    return np.concatenate(origins).astype(points.dtype), np.concatenate(directions).astype(
        points.dtype
    )


def compare(
    mesh: Any, families: dict[str, tuple[np.ndarray, np.ndarray]], **keywords: Any
) -> dict[str, Any]:
    """Errors of `render_rays` on families of rays; `keywords` go to it."""
    dtype = str(np.asarray(mesh.points).dtype)
    reference = BruteForce(mesh)
    length = 0.5 * reference.diagonal
    tf = transfer_function(mesh.values, length, dtype)
    names = np.repeat(list(families), [len(o) for o, _ in families.values()])
    origins, directions = (
        np.concatenate([family[k] for family in families.values()]) for k in (0, 1)
    )
    # the typical depth of a random ray is brought to 3
    some = np.flatnonzero(names == list(families)[0])[:200]
    depth = -np.log1p(-reference.render(origins[some], directions[some], tf)[0][:, 3])
    tf = tf.scaled(float(3.0 / np.median(depth[depth > 0])))
    start = time.perf_counter()
    exact, chord = reference.render(origins, directions, tf)
    seconds = time.perf_counter() - start
    rgba, status = jaxvr.render_rays(mesh, origins, directions, tf, status=True, **keywords)
    rgba = np.asarray(rgba, np.float64)
    error = np.abs(rgba - exact).max(1)
    error = np.where(np.isfinite(error), error, np.inf)
    off = np.flatnonzero(error > TOLERANCE[dtype])
    vague = np.zeros(len(error), bool)
    if len(off):
        vague[off] = reference.ambiguous(
            origins[off], directions[off], tf, NUDGE[dtype], TOLERANCE[dtype]
        )
    clear = ~vague
    return {
        "dtype": dtype,
        "tets": int(mesh.n_tets),
        "rays": len(error),
        "hit": float((chord > 0).mean()),
        "mean_alpha": float(exact[chord > 0, 3].mean()),
        "status": int(np.count_nonzero(np.asarray(status))),
        "ambiguous": int(vague.sum()),
        "ambiguous_worst": float(error[vague].max(initial=0)),
        "off": int((clear & (error > TOLERANCE[dtype])).sum()),
        "worst": float(error[clear].max()),
        "worst_alpha": float(np.abs(rgba - exact)[clear, 3].max()),
        "q9999": float(np.quantile(error[clear], 0.9999)),
        "median": float(np.median(error[clear])),
        "families": {str(k): float(error[clear & (names == k)].max(initial=0)) for k in families},
        "reference_seconds": seconds,
    }


def run_mesh(
    path: Path, dtype: str, rays: int, location: str | None = None, field: str | None = None
) -> dict[str, Any]:
    """All families on one mesh; `location` turns its point data into cell or corner data."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # inverted cells are counted elsewhere
        mesh = read_mesh(path, field, np.dtype(dtype))
    if location is not None:
        mesh = at_location(mesh, location)
    reference = BruteForce(mesh)
    rng = np.random.default_rng(0)
    each = -(-rays // len(FAMILIES))
    families = {k: make_rays(mesh, reference, k, each, rng) for k in FAMILIES}
    if path.stem == "hexa_lattice":
        families["lattice"] = lattice_rays(mesh, reference)
    return {"mesh": path.stem, "location": mesh.location, **compare(mesh, families)}


def at_location(mesh: Any, location: str) -> Any:
    """The same mesh with discontinuous data made from its point data."""
    corner = np.asarray(mesh.values)[np.asarray(mesh.cells)]
    if location == "cell":
        return mesh.replace(values=corner.mean(1), location="cell")
    shifted = corner + 0.1 * np.ptp(corner) * np.sin(np.arange(len(corner)))[:, None]
    return mesh.replace(values=shifted, location="corner")


def check_slab(path: Path, dtype: str) -> dict[str, float]:
    """Largest errors of `Analytic().slab` and its Jacobians, each of its natural scale.

    rgb: of the largest colour of the row; alpha: of 1. Jacobian columns d/d(tau_f, tau_b, l) by
    max |C| times the positive moments that they are made of, l (B1 + B2) / 2, l B2 / 2 and
    (tau_f (B1 + B2) + tau_b B2) / 2 (for the row of alpha, 1 instead of max |C|); those by
    colours by w_f and w_b.
    """
    data = np.load(path)
    rows = data["f32_exact_inputs"] if dtype == "float32" else np.ones(len(data["l"]), bool)
    get = {k: data[k][rows] for k in data.files if data[k].shape[:1] == rows.shape}
    inputs = [get[k].astype(dtype) for k in ("tau_f", "tau_b", "C_f", "C_b", "l")]

    def slab(x):
        rgb, alpha = jaxvr.Analytic().slab(x[0], x[1], x[2:5], x[5:8], x[8])
        return jnp.concatenate([rgb, alpha[None]])

    columns = [x if x.ndim == 2 else x[:, None] for x in inputs]
    x = jnp.asarray(np.concatenate(columns, 1))
    value = np.asarray(jax.jit(jax.vmap(slab))(x), np.float64)
    largest = np.maximum(np.abs(get["C_f"]).max(1), np.abs(get["C_b"]).max(1))
    tau_f, tau_b, length = get["tau_f"], get["tau_b"], get["l"]
    _, b_1, b_2 = get["B"].T
    by = 0.5 * np.stack([length * (b_1 + b_2), length * b_2, tau_f * (b_1 + b_2) + tau_b * b_2], 1)
    scale = np.zeros((len(length), 4, 9))
    scale[:, :3, [0, 1, 8]] = (largest[:, None] * by)[:, None]
    scale[:, 3, [0, 1, 8]] = by
    scale[:, :3, 2:5] = get["w_f"][:, None, None]
    scale[:, :3, 5:8] = get["w_b"][:, None, None]
    # what is 0 for all inputs is held to 0 exactly; subnormal results have an absolute floor
    tiny = float(np.finfo(dtype).tiny)
    scale = np.maximum(scale, tiny * 16)
    out = {
        "rows": int(rows.sum()),
        "rgb": float((np.abs(value[:, :3] - get["rgb"]).max(1) / np.maximum(largest, tiny)).max()),
        "alpha": float(np.abs(value[:, 3] - get["alpha"]).max()),
    }
    for mode in (jax.jacfwd, jax.jacrev):
        jacobian = np.asarray(jax.jit(jax.vmap(mode(slab)))(x), np.float64)
        wrong = np.abs(jacobian - get["jac"]) / scale
        wrong = np.where(np.isfinite(jacobian), wrong, np.inf)
        out[mode.__name__] = float(wrong.max())
    return out


def main(arguments: Any = None) -> list[dict[str, Any]]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rays", type=int, default=20000, help="on each mesh and dtype")
    parser.add_argument("--meshes", nargs="+", default=list(FIELDS), choices=list(FIELDS))
    parser.add_argument("--dtypes", nargs="+", default=["float64", "float32"])
    parser.add_argument("--location", choices=["cell", "corner"], help="make the data such")
    parser.add_argument("--tiny", action="store_true", help="two small meshes and 400 rays")
    parser.add_argument("--json", type=Path, help="write the results there")
    options = parser.parse_args(arguments)
    if options.tiny:
        options.meshes, options.rays = list(TINY), 400
    files = meshes_of(options.meshes, parser)
    jax.config.update("jax_enable_x64", True)
    results = []
    print("largest difference of rgba from brute force")
    print(
        f"{'mesh':16}{'dtype':9}{'rays':>8}{'hit':>6}{'alpha':>7}{'median':>9}{'99.99 %':>9}"
        f"{'worst':>9}{'(alpha)':>9}{'off':>5}{'vague':>6}{'lost':>5}"
    )
    for name, path in files.items():
        for dtype in options.dtypes:
            r = run_mesh(path, dtype, options.rays, options.location, FIELDS[name])
            results.append(r)
            print(
                f"{name:16}{dtype:9}{r['rays']:8}{r['hit']:6.2f}{r['mean_alpha']:7.3f}"
                f"{r['median']:9.1e}{r['q9999']:9.1e}{r['worst']:9.1e}{r['worst_alpha']:9.1e}"
                f"{r['off']:5}{r['ambiguous']:6}{r['status']:5}",
                flush=True,
            )
    print("off: rays beyond 1e-10 (float64) or 2e-5 (float32); vague: ambiguous ones, left out;")
    print("lost: rays with a status bit")
    try:
        vectors = path_of("vectors/segment_vectors_public.npz")
    except FileNotFoundError as error:
        print(error)
    else:
        for dtype in options.dtypes:
            r = {"slab": dtype, **check_slab(vectors, dtype)}
            results.append(r)
            print(
                " ".join(
                    f"{k} {v:.1e}" if isinstance(v, float) else f"{k} {v}" for k, v in r.items()
                )
            )
    if options.json:
        options.json.write_text(json.dumps(results, indent=1) + "\n")
    return results


if __name__ == "__main__":
    main()
