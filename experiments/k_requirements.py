"""Table 1 and Figure 6 of Callahan et al. 2005: how far from sorted the fragments are.

    python -m experiments.k_requirements bluntfin.vtu:density ... [--views 14] [--json F] [--out F]

For each mesh and order of faces, the largest over fourteen viewpoints of: fragments, fragments of a
pixel, positions that a fragment has to move, entries that a k-buffer needs for that, and pixels
that need more than 2 and more than 6. The paper's k is "positions moved minus one"; a buffer of so
few entries does not sort them (see `jaxvr.order.sequence`), so that is not among the columns.
Pictures show the view with most pixels above 6: green where 2 entries do, yellow where 6 do, red
where more are needed; black where there is nothing.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.image import imsave

import jaxvr
from experiments.common import table
from experiments.havs import ORDERS, options, report, viewpoints, volumes
from jaxvr.plot.maps import K_COLORS


def picture(found: jaxvr.KMap) -> np.ndarray:
    """Figure 6: (height, width, 3) uint8."""
    kind = 1 + (found.entries > 2).astype(int) + (found.entries > 6)
    return K_COLORS[np.where(found.fragments > 0, kind, 0)]


def run(
    volume: jaxvr.TetMesh, name: str, size: int, views: int, orders: list[str], out: Path | None
) -> list[dict[str, Any]]:
    rows = []
    for label in orders:
        start, most, order = time.perf_counter(), None, ORDERS[label]
        row: dict[str, Any] = {"mesh": name, "tets": volume.n_tets, "order": label}
        keys = ("fragments", "longest list", "moved", "entries", "> 2", "> 6")
        row |= dict.fromkeys(keys, 0)
        for camera in viewpoints(volume, size)[-views:]:
            found = jaxvr.measure_k(volume, camera, order=order)
            numbers = (
                *(found.fragments.sum(), found.fragments.max(), found.moved.max(), found.k),
                *(found.count_above(2), found.count_above(6)),
            )
            row |= {key: max(row[key], int(x)) for key, x in zip(keys, numbers, strict=True)}
            print(f"{name}, by {label}: {numbers}", flush=True)
            if most is None or found.count_above(6) > most.count_above(6):
                most = found
        row["seconds a view"] = (time.perf_counter() - start) / views
        rows.append(row)
        if out is not None and most is not None:
            out.mkdir(parents=True, exist_ok=True)
            file = out / f"k_{name}_{label.replace(' ', '_')}.png"
            imsave(file, picture(most))
        print(table([row]), flush=True)
    return rows


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    found = options(__doc__, arguments, views=14, orders=list(ORDERS))
    rows = []
    for name, volume in volumes(found).items():
        rows += run(volume, name, found.size, found.views, found.orders, found.out)
    print(table(rows))
    return report(found, rows, "views")


if __name__ == "__main__":
    main()
