"""The report of `experiments.speed` as tables in Markdown, and what was aimed at beside what is.

A target has a number, what is measured, for which mesh, the limit, the value, and whether it is
met. "At least" limits are of VTK's time over jaxvr's; all others are "at most".
"""

from __future__ import annotations

from typing import Any

VTK, RENDER, SHADE, FIT = "VTK, linear", "render", "shade", "fit, one iteration"
LARGE = 2_000_000  # tets; from here on the limits for large meshes hold

# Task, limit on its time over that of the render, number of the target.
OF_THE_RENDER = (
    ("value_and_grad, transfer", 3.0, 2),
    ("value_and_grad, values", 5.0, 2),
    ("value_and_grad, points", 5.0, 2),
    (SHADE, 0.35, 3),
    (FIT, 1.0, 3),
)
SECONDS = {"none": 10.0, "warm": 2.0}  # of a first call, without and with the compile cache
GROWTH = 2.3  # of a render's time with eight times the tets
BYTES_PER_TET = 96
PEAK = 4e9  # bytes of a process that renders a large mesh


def targets(report: dict[str, Any]) -> list[dict[str, Any]]:
    """Every target that the report has numbers for, in the order of their numbers."""
    rows: list[dict[str, Any]] = []

    def add(number: int, what: str, mesh: str, limit: float, value: float, least: bool = False):
        met = value >= limit if least else value <= limit
        row = {"number": number, "what": what, "mesh": mesh, "at_least": least}
        rows.append(row | {"limit": limit, "value": value, "met": bool(met)})

    for run in report["runs"]:
        seconds = run["seconds"]
        if not run["main"]:
            continue
        scene = f"{run['size']} x {run['size']}, {run['points']} control points"
        if VTK in seconds:
            limit = 4.0 if run["tets"] > LARGE else 5.0
            ratio = seconds[VTK] / seconds[RENDER]
            add(1, f"VTK's time over the render's, {scene}", run["mesh"], limit, ratio, True)
        for task, limit, number in OF_THE_RENDER:
            if task in seconds:
                ratio = seconds[task] / seconds[RENDER]
                add(number, f"{task}, of the render", run["mesh"], limit, ratio)
    ordered = sorted(report["scaling"], key=lambda row: row["tets"])
    for small, large in zip(ordered, ordered[1:], strict=False):
        if 7 < large["tets"] / small["tets"] < 9:
            what = f"render, from {small['tets']:,} to {large['tets']:,} tets"
            add(4, what, large["mesh"], GROWTH, large["seconds"] / small["seconds"])
    for row in report["bytes"]:
        what = "bytes a tet: mesh and what XLA reserves for 16 x 16"
        add(5, what, row["mesh"], BYTES_PER_TET, row["small_per_tet"])
    for row in report["processes"]:
        what = {"none": "first render, s", "warm": "first render with a warm cache, s"}
        if row["task"] == "render" and row["size"] == report["size"]:
            add(6, what[row["cache"]], row["mesh"], SECONDS[row["cache"]], row["seconds"])
    largest = max((row["size"] for row in report["processes"]), default=0)
    for row in report["processes"]:
        if row["task"] == "render" and row["cache"] == "none" and row["size"] == largest:
            if "peak" in row:
                what = f"highest memory, GB, {row['size']} x {row['size']}"
                add(8, what, row["mesh"], PEAK / 1e9, row["peak"] / 1e9)
    return sorted(rows, key=lambda row: row["number"])


def markdown(report: dict[str, Any]) -> str:
    """The whole report."""
    about = report["machine"]
    lines = [
        f"{about['cores']} cores of {about['processor']}, JAX {about['jax']} on "
        f"{about['device']}, Python {about['python']}; VTK on {about['vtk_threads']} threads. "
        f"Medians of {report['repeat']} turns; tasks of one run took turns.",
    ]
    for run in report["runs"]:
        if run["main"]:
            lines += ["", *_main(run)]
    if any(not run["main"] for run in report["runs"]):
        lines += ["", "## Sizes and control points", "", *_others(report["runs"])]
    if report["scaling"]:
        lines += ["", "## Tets", "", *_scaling(report["scaling"])]
    if report["processes"]:
        lines += ["", "## First calls and memory of a process", ""]
        lines += _processes(report["processes"])
    if report["bytes"]:
        lines += ["", "## Bytes a tet on the device", "", *_bytes(report["bytes"])]
    lines += ["", "## Targets", "", *_targets(report["targets"])]
    return "\n".join(lines) + "\n"


def _table(head: list[str], rows: list[list[str]]) -> list[str]:
    line = "| {} |".format
    return [line(" | ".join(r)) for r in (head, ["---"] * len(head), *rows)]


def _seconds(x: float | None) -> str:
    return "-" if x is None else f"{x:.2f}" if x >= 1 else f"{x:.3g}"


def _ratio(a: float | None, b: float | None) -> str:
    return "-" if not a or not b else f"{a / b:.2f}"


def _size(row: dict[str, Any]) -> str:
    return f"{row['size']} x {row['size']}"


def _main(run: dict[str, Any]) -> list[str]:
    seconds = run["seconds"]
    head = ["run", "task", "s", "of the render", "VTK's time over it"]
    rows = [
        [str(run["run"]), task, _seconds(s)]
        + [_ratio(s, seconds[RENDER]), _ratio(seconds.get(VTK), s)]
        for task, s in seconds.items()
    ]
    title = f"## {run['mesh']}: {run['tets']:,} tets, {_size(run)}, {run['points']} control points"
    text = (
        f"{run['segments']:,} segments of {run['bytes_per_segment']:.1f} bytes. Largest error "
        f"against `Quadrature`: {run['error']:.1e}"
    )
    if "vtk_error" in run:
        text += (
            f"; VTK's floats {run['vtk_raw_error']:.1e} (1,000 pixels), its 8-bit window "
            f"{run['vtk_error']:.3f} with {run['vtk_pixels_off']} pixels off by more than 0.02 "
            f"({run['vtk_pixels_off_unstretched']} before the window's stretch is allowed for)"
        )
    return [title, "", *_table(head, rows), "", text + "."]


def _others(runs: list[dict[str, Any]]) -> list[str]:
    head = ["run", "mesh", "pixels", "control points", "VTK s", "render s", "VTK / render"]
    head += ["shade s", "of the render", "error", "VTK's floats", "VTK's pixels off"]
    rows = []
    for run in runs:
        s = run["seconds"]
        row = [str(run["run"]), run["mesh"], _size(run), str(run["points"])]
        row += [_seconds(s.get(VTK)), _seconds(s[RENDER]), _ratio(s.get(VTK), s[RENDER])]
        row += [_seconds(s.get(SHADE)), _ratio(s.get(SHADE), s[RENDER]), f"{run['error']:.1e}"]
        raw, off = run.get("vtk_raw_error"), run.get("vtk_pixels_off")
        rows.append(row + ["-" if raw is None else f"{raw:.1e}", "-" if off is None else str(off)])
    return _table(head, rows)


def _scaling(rows: list[dict[str, Any]]) -> list[str]:
    first = rows[0]
    head = ["run", "mesh", "tets", "render s", f"of {first['mesh']}", "tets, of it"]
    return _table(
        head,
        [
            [str(r["run"]), r["mesh"], f"{r['tets']:,}", _seconds(r["seconds"])]
            + [_ratio(r["seconds"], first["seconds"]), _ratio(r["tets"], first["tets"])]
            for r in rows
        ],
    )


def _processes(rows: list[dict[str, Any]]) -> list[str]:
    head = ["mesh", "what", "pixels", "compile cache", "s", "MB: mesh read", "before"]
    head += ["highest after", "highest of all", "after less before, bytes a tet"]
    out = []
    for r in rows:
        row = [r["mesh"], r["task"], _size(r), "-" if r["task"] == "vtk" else r["cache"]]
        row.append(_seconds(r["seconds"]))
        if "peak" in r:
            keys = ("rss_read", "rss_before", "peak_after", "peak")
            row += [f"{r[key] / 1e6:,.0f}" for key in keys]
            row.append(f"{(r['peak_after'] - r['rss_before']) / r['tets']:,.0f}")
        out.append(row + ["-"] * (len(head) - len(row)))
    return _table(head, out)


def _bytes(rows: list[dict[str, Any]]) -> list[str]:
    size = _size(rows[0])
    head = ["mesh", "tets", "mesh", "and reserved for 16 x 16", f"and reserved for {size}"]
    return _table(
        head,
        [
            [r["mesh"], f"{r['tets']:,}"]
            + [f"{r[f'{key}_per_tet']:.1f}" for key in ("mesh", "small", "image")]
            for r in rows
        ],
    )


def _targets(rows: list[dict[str, Any]]) -> list[str]:
    head = ["target", "what", "mesh", "limit", "measured", ""]
    out = []
    for r in rows:
        part = abs(r["value"] / r["limit"] - 1)
        verdict = f"{'met' if r['met'] else 'missed'} by {part:.0%}"
        limit = f"{'at least' if r['at_least'] else 'at most'} {r['limit']:g}"
        out.append([str(r["number"]), r["what"], r["mesh"], limit, f"{r['value']:.3g}", verdict])
    return _table(head, out)
