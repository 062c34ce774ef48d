"""What the experiments on visibility sorting (Callahan et al. 2005) share: viewpoints and options.

The paper takes fourteen fixed viewpoints without saying which. Here they are the middles of the
faces and the corners of a cube round the mesh, from where its bounding ball fits a field of view of
30 degrees.
"""

from __future__ import annotations

import argparse
import itertools
from pathlib import Path
from typing import Any

import numpy as np

import jaxvr
from experiments.common import diagonal, machine, read_volume, write_json

ORDERS = {"centroid": jaxvr.order.Centroid(), "first vertex": jaxvr.order.FirstVertex()}


def viewpoints(volume: jaxvr.TetMesh, size: int) -> list[jaxvr.Camera]:
    """Fourteen pinhole cameras: along the axes, then along the diagonals of space."""
    lo, hi = (np.asarray(x, np.float64) for x in volume.bounds())
    target, distance = (lo + hi) / 2, diagonal(volume) / 2 / np.sin(np.deg2rad(15))
    axes = [s * np.eye(3)[axis] for axis in range(3) for s in (1, -1)]
    corners = [np.array(x) / np.sqrt(3) for x in itertools.product((1.0, -1.0), repeat=3)]
    return [
        jaxvr.Camera.look_at(
            *(target + distance * way, target),
            up=(0, 0, 1) if abs(way[1]) > 0.9 else (0, 1, 0),
            fov=30.0,
            width=size,
            height=size,
            dtype=volume.dtype,
        )
        for way in axes + corners
    ]


def options(description: str | None, arguments: Any, **more: Any) -> argparse.Namespace:
    """Options of these experiments. more: from name to default, numbers or lists of numbers."""
    parser = argparse.ArgumentParser(description=(description or "").splitlines()[0])
    parser.add_argument("meshes", nargs="*", help="files of meshes, name or name:field")
    parser.add_argument("--size", type=int, default=512, help="pixels along each side")
    parser.add_argument("--json", type=Path, help="write the numbers there")
    parser.add_argument("--out", type=Path, help="folder for pictures")
    parser.add_argument("--tiny", action="store_true", help="a small box and few pixels")
    for name, default in more.items():
        many = isinstance(default, list)
        kind = type(default[0] if many else default)
        parser.add_argument(f"--{name}", type=kind, default=default, nargs="+" if many else None)
    found = parser.parse_args(arguments)
    if found.tiny:
        found.size = 12
    return found


def volumes(found: argparse.Namespace) -> dict[str, jaxvr.TetMesh]:
    """The meshes asked for by name, in float32."""
    if found.tiny:
        return {"box": read_volume()}
    out = {}
    for given in found.meshes:
        path, _, field = given.partition(":")
        out[Path(path).stem] = read_volume(path, field or None)
    return out


def report(found: argparse.Namespace, rows: Any, *names: str) -> dict[str, Any]:
    """Machine, size, the options of these names and the numbers; written where --json says."""
    out = {"machine": machine(), "size": found.size}
    out |= {name: getattr(found, name) for name in names} | {"rows": rows}
    if found.json:
        write_json(found.json, out)
    return out
