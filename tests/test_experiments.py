"""Every experiment runs at a tiny size, and one number of each is pinned.

To add one: a function from a folder to a number, and the bounds that it must lie in.
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import numpy as np
import pytest

import jaxvr
from experiments import (
    against,
    beside_vtk,
    control_points,
    cut_and_merge,
    demo,
    file_faults,
    fit_transfer,
    flat_cells,
    full_vs_partial,
    integrators,
    k_requirements,
    kbuffer_exact,
    kbuffer_memory,
    kbuffer_refine,
    kbuffer_speed,
    kbuffer_stages,
    layouts,
    library_faults,
    limits,
    log_table,
    mesh_faults,
    offsets,
    preintegration_build,
    quantised_table,
    speed,
    units,
)
from experiments.common import read_volume
from experiments.havs import viewpoints


def demo_psnr(folder: Path) -> float:
    report = demo.run(folder, tiny=True)
    assert (folder / "overview.png").stat().st_size > 0 and (folder / "report.json").exists()
    return report["held_out"][0]["psnr"]


def fit_transfer_psnr(folder: Path) -> float:
    volume = jaxvr.datasets.heat_sink(fins=2)  # the shapes of the demo: compiled already
    report = fit_transfer.run(
        volume, folder, size=16, reference_points=64, schedules=("decay",), passes=40, uncached=0
    )
    assert (folder / "decay" / "difference.png").exists()
    return report["schedules"]["decay"]["held_out"][0]["psnr"]


def preintegration_build_gain(folder: Path) -> float:
    """How many times smaller the mean error of halves is than that of slices one by one."""
    report = preintegration_build.main(["--tiny", "--out", str(folder)])
    assert (folder / "preintegration_build.png").stat().st_size > 0
    assert report["wait"][0]["compilations"] == 2  # of prepare and of its gradient, once each
    means = {row["build"]: row["mean error"] for row in report["build"]}
    return means["linear, one by one"] / means["linear, halves"]


def log_table_gain(folder: Path) -> float:
    """How many times smaller the rms error is with logarithmic lengths, on a mesh whose cells get
    many times thinner from one end to the other."""
    mesh = jaxvr.datasets.heat_sink(fins=2)  # the shapes of the demo: compiled already
    x, y, z = np.asarray(mesh.points).T
    mesh = mesh.replace(points=np.stack([x, y, z * (z / z.max()) ** 2], 1))
    report = log_table.run(
        mesh, folder, size=16, nodes=128, slices=(8,), shown=8, functions=("shells",)
    )
    assert (folder / "log_table_shells.png").stat().st_size > 0
    rms = {row["table"]: row["rms"] for row in report["transfer"]["shells"]}
    return rms["linear"] / rms["log"]


def offsets_error(folder: Path) -> float:
    found = offsets.run(8)
    errors = [x for x in found.values() if x is not None]
    assert len(errors) == len(found) > 20
    return max(errors)


def against_itself(folder: Path) -> float:
    folder.mkdir()
    jaxvr.write_mesh(folder / "mesh.vtu", jaxvr.datasets.box((2, 2, 2)))
    here = against.HERE
    rows = against.compare(here, here, folder / "mesh.vtu", 16, "C", 3, tasks=["render"])
    assert rows[0]["seconds"] > 0
    return rows[0]["ratio"]


def cut_and_merge_apart(folder: Path) -> float:
    mesh = jaxvr.datasets.box((3, 3, 3), jitter=0.2, seed=1, dtype="float32")
    found = cut_and_merge.run(mesh, 64)
    return max(x for by_engine in found.values() for x in by_engine.values())


def units_range(folder: Path) -> float:
    """The exponent that scalars and lengths reach in float32 by all ways."""
    rows = units.main(["--tiny"])["rows"]
    for row in rows:
        assert "off" not in row["beyond from"] + row["beyond to"], row
    double = [r for r in rows if r["dtype"] == "float64"]
    assert min(min(-r["from"], r["to"]) for r in double) == 957  # in steps of 319
    single = [r for r in rows if r["dtype"] == "float32"]
    return min(min(-r["from"], r["to"]) for r in single)


def library_faults_good(folder: Path) -> float:
    """The part of states that end well."""
    rows = library_faults.main(["--tiny"])["states"]
    assert any(row["rendered"] for row in rows)
    return sum(row["outcome"] in (*library_faults.GOOD, "not tried") for row in rows) / len(rows)


def mesh_faults_wrong(folder: Path) -> float:
    """Pictures of eight mutants that are wrong without a word, or late."""
    rows = mesh_faults.main(["--tiny"])["table"]
    assert sum(row["error"] + row["status"] for row in rows) > 0
    return sum(row[bad] for row in rows for bad in mesh_faults.BAD)


def quantised_table_gain(folder: Path) -> float:
    """How many times smaller the error of rounding is with 16 bits than with 8: up to 257."""
    report = quantised_table.main(["--tiny", "--out", str(folder)])
    assert (folder / "quantised_table_log.png").stat().st_size > 0
    rms = {row["bits"]: row["rms"] for row in report["tables"] if row["against"] == "float"}
    return rms[8] / rms[16]


def full_vs_partial_error(folder: Path) -> float:
    """The largest error of partial pre-integration, where a full table of 16 nodes is useless."""
    report = full_vs_partial.main(["--tiny", "--out", str(folder)])
    assert (folder / "full_vs_partial.png").stat().st_size > 0
    largest = {row["integrator"]: row["max"] for row in report["errors"]}
    assert largest["full, 128^3"] > 0.01
    return largest["partial, bicubic 128^2"]


def integrators_error(folder: Path) -> float:
    chosen = {"Analytic()": jaxvr.Analytic()}
    slabs = {k: np.array([0.5, 2.0]) for k in ("tau_f", "tau_b", "l")}
    slabs |= {k: np.full((2, 3), 0.5) for k in ("C_f", "C_b")} | {
        "f32_exact_inputs": np.ones(2, bool)
    }
    slabs["alpha"] = 1 - np.exp(-slabs["tau_f"] * slabs["l"])
    slabs["rgb"] = 0.5 * slabs["alpha"][:, None] * np.ones(3)
    volume = jaxvr.datasets.box((2, 2, 2), jitter=0.2, dtype="float32")
    report = integrators.run({"box": volume}, 8, 1, slabs, chosen, lanes=(8, 2))
    assert report["slab"]["Analytic()"]["error"] < 5e-7
    assert report["box"]["Analytic()"]["extinctions"] < 1e-4
    return report["box"]["Analytic()"]["error"]


def control_points_pieces(folder: Path) -> float:
    volume = jaxvr.datasets.box((2, 2, 2), jitter=0.2, dtype="float32")
    chosen = {"Analytic": jaxvr.Analytic()}
    report = control_points.run({"box": volume}, 8, 1, (10,), chosen)
    assert report["box"][10]["render Analytic"] > 0
    return report["box"][10]["pieces"]


def layouts_chord(folder: Path) -> float:
    """The worst chord of planes, where the exact walk takes RayCast's own paths."""
    report = layouts.main(["--tiny", "--json", str(folder / "layouts.json")])
    (box,) = report.values()
    for part in ("picture", "aimed"):
        exact = box[part]["exact"]
        assert exact["lost"] == exact["other cells"] == 0 and exact["worst chord"] < 1e-6
    assert box["picture"]["plain"]["worst chord"] < 1e-6
    return box["picture"]["planes"]["worst chord"]


def speed_error(folder: Path) -> float:
    """The largest error of a render; some of the tasks, and memory in a process of its own."""
    files = ["--json", str(folder / "speed.json"), "--markdown", str(folder / "speed.md")]
    report = speed.main(["--tiny", "--only", "shade", "fit", "memory", *files])
    assert json.loads((folder / "speed.json").read_text()) == report
    assert "| 1 | fit, one iteration |" in (folder / "speed.md").read_text()
    assert {row["number"] for row in report["targets"]} == {3, 6, 8}
    return report["runs"][0]["error"]


def limits_cells(folder: Path) -> float:
    """Cells on a ray through a box of 3 x 3 x 3 blocks of six."""
    report = limits.main(["--tiny", "--json", str(folder / "limits.json")])
    assert all(x > 0 for x in report["machine"].values())
    return report["meshes"][0]["cells a ray"]


def k_requirements_entries(folder: Path) -> float:
    report = k_requirements.main(["--tiny", "--views", "2", "--out", str(folder)])
    assert (folder / "k_box_first_vertex.png").stat().st_size > 0
    assert {row["order"] for row in report["rows"]} == {"centroid", "first vertex"}
    return report["rows"][0]["entries"]


def kbuffer_exact_error(folder: Path) -> float:
    """The largest error with as many entries as are needed; fewer are told."""
    rows = kbuffer_exact.main(["--tiny"])["rows"]
    assert all(row["untold"] == 0 for row in rows)
    enough = [row for row in rows if row["k"] >= row["needed"]]
    assert max(row["gradient"] for row in enough if row["dtype"] == "float64") < 1e-10
    return max(row["error"] for row in enough) + 1e-9


def kbuffer_speed_rate(folder: Path) -> float:
    (row,) = kbuffer_speed.main(["--tiny"])["rows"]
    return row["k = 6"] / row["k = 2"]


def kbuffer_stages_fragments(folder: Path) -> float:
    number = kbuffer_stages.main(["--tiny"])["rows"][-1]["number"]
    volume = read_volume()
    return number / jaxvr.measure_k(volume, viewpoints(volume, 12)[-1]).fragments.sum()


def kbuffer_memory_bytes(folder: Path) -> float:
    (row,) = kbuffer_memory.main(["--tiny"])["rows"]
    return row["reserved"] / row["with 64 KiB for rays"]


def kbuffer_refine_change(folder: Path) -> float:
    rows = kbuffer_refine.main(["--tiny"])["rows"]
    assert rows[1]["tets"] > rows[0]["tets"]
    return max(row["change"] for row in rows)


def flat_cells_error(folder: Path) -> float:
    """The worst chord of rays at features of a lattice, as it is and moved; none is lost."""
    file = folder.with_suffix(".json")
    names = ["lattice", flat_cells.MOVED]
    given = ["--tiny", "--dtypes", "float32", "--meshes", *names, "--json", str(file)]
    report = flat_cells.main(given)["after"]
    assert json.loads(file.read_text())["after"] == report
    assert [row["mesh"] for row in report["rows"]] == names
    for row in report["rows"]:
        assert row["status"] == row["chord"]["off 1e-4"] == row["picture"]["off 1e-4"] == 0
    as_is, moved = report["gradients"]
    assert as_is["pairs"] > 4 and moved["sides differ"] == 0
    for slopes in (as_is, moved):
        assert slopes["equal"] == slopes["sides agree"] > 0
    return max(row["chord"]["worst"] for row in report["rows"])


def beside_vtk_error(folder: Path) -> float:
    return beside_vtk.main(["--tiny", "--out", str(folder)])["rows"][0]["max"]


def file_faults_wrong(folder: Path) -> float:
    """Of mutated files and of threads side by side."""
    found = file_faults.mutants(60, 0)["outcomes"]
    bad = [k for k in found if not k.startswith(("error:", "a mesh"))]
    side_by_side = file_faults.threads(1.0)
    assert sum(found.values()) == 60 and side_by_side["written and read"] > 0
    return len(bad) + len(side_by_side["wrong"])


EXPERIMENTS = [
    (beside_vtk_error, 0, 0.1),
    (flat_cells_error, 1e-9, 1e-6),
    (k_requirements_entries, 1, 10),
    (kbuffer_exact_error, 1e-10, 1e-5),
    (kbuffer_speed_rate, 0.1, 10),
    (kbuffer_stages_fragments, 0.999, 1.001),
    (kbuffer_memory_bytes, 2, 10),
    (kbuffer_refine_change, 1e-9, 1e-5),
    (demo_psnr, 25, 200),
    (fit_transfer_psnr, 25, 200),
    (preintegration_build_gain, 1.2, 20),
    (log_table_gain, 2, 100),
    (quantised_table_gain, 100, 300),
    (full_vs_partial_error, 0, 2e-6),
    (integrators_error, 1e-9, 1e-6),
    (control_points_pieces, 1.2, 10),
    (speed_error, 1e-9, 1e-6),
    (layouts_chord, 1e-9, 1e-6),
    (limits_cells, 5, 20),
    (units_range, 98, 100),
    (offsets_error, 1e-8, 1e-5),
    (cut_and_merge_apart, 1e-9, 1e-6),
    (against_itself, 0.05, 20),
    (library_faults_good, 0.999, 1.001),
    (mesh_faults_wrong, -1, 1),
    (file_faults_wrong, -1, 1),
]


@pytest.mark.parametrize(
    ("run", "low", "high"), EXPERIMENTS, ids=lambda x: getattr(x, "__name__", "")
)
def test_experiment(run, low, high, tmp_path, quick_jit):
    assert low < run(tmp_path / "out") < high


SCRIPTS = sorted(p.stem for p in Path(__file__).parents[1].glob("experiments/[a-z]*.py"))


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_can_be_imported_and_say_what_they_do(name):
    """Also those that need a browser, a network or an hour, and do not run here."""
    script = importlib.import_module(f"experiments.{name}")
    assert script.__doc__
