"""Pictures in float32 of numbers that are far from 0 and close together, against float64.

    python -m experiments.offsets [--size 64]

A unit cube of 1,296 tetrahedra with a smooth field and a transfer function of six control points
that let light through, its field and its points scaled and moved as in data of the real world. Each
is rendered in float32 and in float64; both take their numbers from float64. The script uses nothing
but public functions, so that it runs on checkouts from before there were offsets, too.
"""

from __future__ import annotations

import argparse
import warnings
from typing import Any

import jax
import numpy as np

import jaxvr

FIELDS = {"101325 + 0.01 f": (101325, 0.01), "300 + 1e-5 f": (300, 1e-5), "1e6 + f": (1e6, 1.0)}
PLACES = {
    "10 m at (4.5e5, 5.2e6, 0)": ((4.5e5, 5.2e6, 0), 10),
    "100 m at (4.5e5, 5.2e6, 300)": ((4.5e5, 5.2e6, 300), 100),
    "1 at (1e5, 1e5, 1e5)": ((1e5, 1e5, 1e5), 1),
}
TIMES = (0, 4, 8, 16, 31, 33, 64, 1e3, 1e6)


def picture(
    dtype: str, size: int, field: tuple[float, float] = (0, 1), place: Any = ((0, 0, 0), 1)
) -> np.ndarray:
    """RGBA (size, size, 4) of the cube whose field and points are scaled, then moved."""
    (away, scale), (corner, length) = field, place
    base = jaxvr.datasets.box((6, 6, 6), dtype="float64")
    points = np.asarray(base.points, np.float64)
    values = np.sin(2 * points[:, 0]) + 0.4 * points[:, 1] * points[:, 2]
    colors = np.random.default_rng(0).uniform(size=(6, 3))
    positions = np.linspace(values.min(), values.max(), 6) * scale + away
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # without offsets there are some on collapsed cells
        mesh = jaxvr.TetMesh.from_cells(
            points * length + np.asarray(corner),
            {"tetra": np.asarray(base.cells)},
            values * scale + away,
            dtype=dtype,
        )
        extinctions = np.array([0, 2, 0.3, 4, 1, 6]) / length
        transfer = jaxvr.TransferFunction(positions, colors, extinctions, dtype=dtype)
        target = np.asarray(corner) + length * 0.5
        eye = target + length * np.array([1.3, 0.8, 2.0])
        camera = jaxvr.Camera.look_at(eye, target, width=size, height=size, dtype=dtype)
        return np.asarray(jaxvr.render(mesh, camera, transfer))


def run(size: int = 64) -> dict[str, float | None]:
    """The largest difference of the two pictures for each case; None where there is none."""
    cases: dict[str, dict[str, Any]] = {f"field {k}": {"field": v} for k, v in FIELDS.items()}
    cases |= {f"cube of {k}": {"place": v} for k, v in PLACES.items()}
    for n in TIMES:
        cases |= {f"field {n:g} times its range from 0": {"field": (1.2 * n, 1.0)}}
        cases |= {f"cube {n:g} times its size from 0": {"place": ((n, n, n), 1)}}
    found: dict[str, float | None] = {}
    for name, case in cases.items():
        try:
            found[name] = float(
                np.abs(picture("float32", size, **case) - picture("float64", size, **case)).max()
            )
        except ValueError:  # control points, or all points, that float32 makes one
            found[name] = None
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description="float32 far from 0, against float64.")
    parser.add_argument("--size", type=int, default=64)
    jax.config.update("jax_enable_x64", True)
    for name, error in run(parser.parse_args().size).items():
        print(f"{name:40} {'refused' if error is None else f'{error:.1e}'}")


if __name__ == "__main__":
    main()
