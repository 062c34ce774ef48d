"""The command line: what it writes, and that errors are one line and exit code 2."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import matplotlib.image
import numpy as np
import pytest

import jaxvr
from jaxvr.cli import main
from jaxvr.defaults import UPS, best_up
from tests.mesh_files import MSH_OF_TWO_BLOCKS
from tests.stand_ins import flow_fields, named, ring

pytestmark = pytest.mark.usefixtures("quick_code")


@pytest.fixture(scope="module")
def mesh(tmp_path_factory):
    path = tmp_path_factory.mktemp("mesh") / "box.vtu"
    jaxvr.write_mesh(path, jaxvr.datasets.box((2, 2, 2), dtype="float32"))
    return str(path)


@pytest.fixture(scope="module")
def tf(tmp_path_factory):
    path = tmp_path_factory.mktemp("tf") / "tf.json"
    x = np.linspace(0, 1, 6)
    jaxvr.TransferFunction.from_colormap("turbo", x, [1, 4, 0, 6, 1, 8]).to_json(path)
    return str(path)


SMALL = ["--width", "12", "--height", "12"]


def test_info(mesh, capsys):
    assert main(["info", mesh]) == 0
    out = capsys.readouterr().out
    assert "values (point)" in out and "48 tetrahedra" in out


@pytest.mark.parametrize("file", named("plot3d/bluntfinxyz.bin", "tube.xyz"))
def test_info_plot3d(file_of, file, capsys):
    count = {"tube.xyz": "210 tetrahedra"}.get(file, "224,759 tetrahedra")
    assert main(["info", str(file_of(file)), "--field", "y"]) == 0
    assert count in capsys.readouterr().out


def test_info_plot3d_solution(file_of, capsys):
    files = [str(file_of(name)) for name in ("tube.xyz", "tube.q")]
    assert main(["info", files[0], "--q", files[1], "--field", "pressure"]) == 0
    out, want = capsys.readouterr().out, flow_fields(ring(0.0).points)["pressure"]
    assert "pressure" in out and f"{want.min():.4g}" in out and f"{want.max():.4g}" in out, out


STEPS_AND_BLOCKS = f"""{MSH_OF_TWO_BLOCKS}$Nodes
5
1 0 0 0
2 1 0 0
3 0 1 0
4 0 0 1
5 0 0 -3
$EndNodes
$Elements
2
1 4 2 8 1 1 2 3 4
2 4 2 7 1 1 3 2 5
$EndElements
"""


@pytest.fixture(scope="module")
def steps(tmp_path_factory):
    """A gmsh file with two blocks, and steps k at 0, 0.5 and 1, of values 100 k to 100 k + 4."""
    path = tmp_path_factory.mktemp("steps") / "a.msh"
    text = STEPS_AND_BLOCKS
    for k in range(3):
        rows = "".join(f"{n + 1} {100 * k + n}\n" for n in range(5))
        text += f'$NodeData\n1\n"temp"\n1\n{k / 2}\n3\n{k}\n1\n5\n{rows}$EndNodeData\n'
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize(
    ("given", "field", "tets"),
    [
        (["--step", "0"], "0 to 4", 2),
        (["--step", "1"], "100 to 104", 2),
        (["--step=-1"], "200 to 204", 2),
        (["--step", "0.5"], "100 to 104", 2),
        (["--step", "1.0"], "200 to 204", 2),
        (["--step", "0", "--block", "upper part"], "0 to 3", 1),
        (["--step", "5e-1", "--block", "lower part"], "100 to 104", 1),
    ],
)
def test_steps_and_blocks(given, field, tets, steps, tmp_path, capsys):
    assert main(["info", steps, *given]) == 0
    said = capsys.readouterr()
    assert f"point data, {field}\n" in said.out and said.err == ""
    assert f"{tets} tetrahedr" in said.out
    assert "temp (point, 3 steps, blocks lower part, upper part)" in said.out
    out = tmp_path / "a.npy"
    assert main(["render", steps, "-o", str(out), "--width", "2", "--height", "2", *given]) == 0
    assert f"field temp, {field}, colours from" in capsys.readouterr().out


def test_the_step_that_was_taken_is_told(steps, capsys):
    assert main(["info", steps]) == 0
    said = capsys.readouterr()
    assert "point data, 200 to 204\n" in said.out
    (line,) = said.err.strip().splitlines()
    assert line.startswith(
        "jaxvr: warning: a.msh: It has 3 time steps, at 0 to 1, of which the last"
    )


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--step", "3"], "There is no step 3: it has 3, at times 0, 0.5, 1"),
        (["--step", "0.25"], "There is no step at time 0.25"),
        (["--step", "last"], "--step must be an index (3) or a time with a point (0.5)"),
        (["--step", "nan"], "There is no step at time nan"),
        (["--step", "0", "--block", "middle"], "There is no block 'middle'. It has 'lower part', "),
    ],
)
def test_steps_and_blocks_that_are_not_there(given, message, steps, capsys):
    assert main(["render", steps, "-o", "a.npy", *given]) == 2
    said = capsys.readouterr()
    (line,) = said.err.strip().splitlines()
    assert line.startswith("jaxvr: error: ") and message in line and said.out == ""


def test_render_png_is_transparent_and_npy_is_exact(mesh, tf, tmp_path, capsys):
    for name in ("a.png", "a.npy"):
        assert main(["render", mesh, "--tf", tf, "-o", str(tmp_path / name), *SMALL]) == 0
    image = np.load(tmp_path / "a.npy")
    volume = jaxvr.read_mesh(mesh)
    up = UPS[best_up(volume, jaxvr.TransferFunction.from_json(tf))]
    camera = jaxvr.Camera.orbit(volume, up=up, width=12, height=12)
    want = jaxvr.render(volume, camera, jaxvr.TransferFunction.from_json(tf))
    np.testing.assert_allclose(image, want, atol=1e-6)
    png = matplotlib.image.imread(tmp_path / "a.png")
    assert png.shape == (12, 12, 4) and png[0, 0, 3] == 0
    np.testing.assert_allclose(png[..., 3], image[..., 3], atol=0.51 / 255)
    assert "a.png" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "said", "camera"),
    [
        (["--up", "z"], "up (0, 0, 1)", {"up": (0, 0, 1)}),
        (["--up=-y", "--azimuth", "70"], "up (0, -1, 0)", {"up": (0, -1, 0), "azimuth": 70}),
        (["--up", "0,1,1", "--zoom", "2"], "up (0, 1, 1)", {"up": (0, 1, 1), "zoom": 2}),
        (["--eye", "3", "2", "4"], "up (0, 1, 0)", {"eye": (3, 2, 4)}),
        (["--eye", "0.5", "9", "0.5"], "up (0, 0, 1)", {"eye": (0.5, 9, 0.5), "up": (0, 0, 1)}),
    ],
)
def test_where_it_is_seen_from(given, said, camera, mesh, tmp_path, capsys):
    assert main(["render", mesh, "-o", str(tmp_path / "a.npy"), *SMALL, *given]) == 0
    out = capsys.readouterr().out
    assert said in out and "field values, " in out and "colours from" in out
    volume = jaxvr.read_mesh(mesh)
    make = jaxvr.Camera.look_at if "eye" in camera else jaxvr.Camera.orbit
    first = {"target": (0.5, 0.5, 0.5)} if "eye" in camera else {"volume": volume}
    view = make(**first, **camera, width=12, height=12)
    want = jaxvr.render(volume, view, jaxvr.default_transfer(volume))
    np.testing.assert_allclose(np.load(tmp_path / "a.npy"), want, atol=1e-5)


def test_the_chosen_axis_is_told_and_a_scalar_bar_is_drawn(mesh, tmp_path, capsys):
    out = str(tmp_path / "bar.png")
    assert main(["render", mesh, "-o", out, *SMALL, "--scalar-bar"]) == 0
    assert " up, which shows most (--up)" in capsys.readouterr().out
    assert min(matplotlib.image.imread(out).shape[:2]) > 100  # a figure round the 12 pixels


def test_render_colormap_on_a_background(mesh, tmp_path):
    out = str(tmp_path / "b.npy")
    arguments = ["--background", "1", "0.5", "0", "--opacity", "2", "--azimuth", "-40"]
    assert main(["render", mesh, "-o", out, *SMALL, *arguments]) == 0
    image = np.load(out)
    np.testing.assert_allclose(image[0, 0], [1, 0.5, 0, 1], atol=1e-6)
    np.testing.assert_allclose(image[..., 3], 1, atol=1e-6)


def test_fit(mesh, tf, tmp_path, capsys):
    out = tmp_path / "fit"
    arguments = ["--points", "6", "--views", "2", "--iterations", "60", "--size", "12", "--quiet"]
    assert main(["fit", mesh, "--reference-tf", tf, "-o", str(out), *arguments]) == 0
    assert "PSNR" in capsys.readouterr().out
    report = json.loads((out / "report.json").read_text())
    assert report["held_out"][0]["psnr"] > 20
    for name in ("target", "start", "fitted", "difference", "transfer", "overview"):
        assert (out / f"{name}.png").stat().st_size > 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["render", "MESH", "-o", "OUT/a.png", "--tf", "virids"], "Did you mean viridis"),
        (["render", "MESH", "-o", "OUT/a.png", "--tf", "no.json"], "no file 'no.json'"),
        (["render", "MESH", "-o", "OUT/a.png", "--tf", "MESH/x.json"], "There is no file"),
        (["render", "MESH", "-o", "OUT/a.jpg"], ".png, .npy or .exr"),
        (["render", "MESH", "-o", "OUT/none/a.png"], "There is no folder"),
        (["render", "MESH", "-o", "OUT/a.png", "--field", "heat"], "no field 'heat'"),
        (["render", "MESH", "-o", "OUT/a.png", "--zoom", "0"], "zoom"),
        (["render", "MESH", "-o", "OUT/a.png", "--width", "0"], "width"),
        (["render", "MESH", "-o", "OUT/a.png", "--opacity", "-1"], "not be negative"),
        (["render", "MESH", "-o", "OUT/a.png", "--width", "x"], "invalid int value"),
        (["render", "MESH", "-o", "OUT/a.npy", "--scalar-bar"], "drawn on a .png"),
        (["render", "MESH", "-o", "OUT/a.png", "--up", "w"], "invalid axis value"),
        (["render", "MESH", "-o", "OUT/a.png", "--up", "0,0,0"], "invalid axis value"),
        (["render", "MESH", "-o", "OUT/a.png", "--eye", "1", "2", "3", "--zoom", "2"], "--zoom"),
        (["render", "MESH"], "required"),
        (["render", "nowhere.vtu", "-o", "OUT/a.png"], "nowhere.vtu"),
        (["info", "OUT"], "folder"),
        (["info", "OUT/junk.vtu"], "junk.vtu"),
        (["info", "OUT/junk.bin"], "junk.bin"),
        (["fit", "MESH", "--reference-tf", "viridis", "-o", "OUT/f", "--points", "1"], "points"),
        (["fit", "MESH", "--reference-tf", "viridis", "-o", "OUT/f", "--views", "0"], "n must"),
        (["draw"], "invalid choice"),
        ([], "required"),
    ],
)
def test_errors_are_one_line(arguments, message, mesh, tmp_path, capsys):
    (tmp_path / "junk.vtu").write_text("<VTKFile")
    (tmp_path / "junk.bin").write_bytes(b"abc")
    arguments = [a.replace("MESH", mesh).replace("OUT", str(tmp_path)) for a in arguments]
    assert main(arguments) == 2
    captured = capsys.readouterr()
    lines = captured.err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("jaxvr: error: ") and message in lines[0]
    assert captured.out == ""


def test_warnings_are_one_line(mesh, tf, tmp_path, capsys):
    far = tmp_path / "far.json"
    jaxvr.TransferFunction([50.0, 60.0], np.ones((2, 3)), [1.0, 2.0]).to_json(far)
    assert main(["render", mesh, "--tf", str(far), "-o", str(tmp_path / "a.npy"), *SMALL]) == 0
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("jaxvr: warning: The field lies from")


@pytest.mark.parametrize("command", [[], ["info"], ["render"], ["fit"]])
def test_help(command, capsys):
    assert main([*command, "--help"]) == 0
    assert "usage: jaxvr" in capsys.readouterr().out


def test_python_m_jaxvr_as_users_run_it(mesh, tmp_path):
    """In a process of its own, without x64: no warning either. Nor from what the first has compiled
    for the second, in a folder that nobody else can write to."""
    out = tmp_path / "a.npy"
    names = {"JAX_COMPILATION_CACHE_DIR", "TF_CPP_MIN_LOG_LEVEL"}  # those of `conftest`
    environment = {name: x for name, x in os.environ.items() if name not in names}
    environment["JAXVR_CACHE"] = str(tmp_path / "cache")

    def run(*arguments):
        command = [sys.executable, "-m", "jaxvr", *arguments]
        return subprocess.run(command, capture_output=True, text=True, env=environment)

    kept = []
    for _ in range(2):
        done = run("render", mesh, "-o", str(out), *SMALL)
        assert (done.returncode, done.stderr) == (0, "") and np.load(out).dtype == np.float32
        folder = tmp_path / "cache" / "xla"
        assert folder.stat().st_mode & 0o077 == 0
        kept.append({file.name for file in folder.iterdir() if not file.name.endswith("atime")})
    assert kept[0] and kept[0] <= kept[1]  # what compiles quickly is kept or not, as it happens
    done = run("info", "nowhere.vtu")
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.strip().splitlines() == ["jaxvr: error: There is no file 'nowhere.vtu'."]


def test_the_command_line_resumes_only_when_told(mesh, tf, tmp_path, capsys):
    kept = tmp_path / "c.npz"
    begin = ["fit", mesh, "--reference-tf", tf, "-o", str(tmp_path / "f"), "--quiet"]
    begin += ["--points", "4", "--views", "1", "--iterations", "2", "--size", "8"]
    begin += ["--checkpoint", str(kept)]
    assert main(begin) == 0
    assert capsys.readouterr().err == ""
    kept.write_bytes(kept.read_bytes()[:-30])
    assert main([*begin, "--resume"]) == 2
    assert "c.npz' is no checkpoint of a fit" in capsys.readouterr().err
    kept.unlink()
    assert main([*begin, "--resume"]) == 0
    assert "There is no checkpoint" in capsys.readouterr().err
    assert main(begin) == 0
    told = capsys.readouterr().err
    assert "holds 2 iterations. The fit starts anew and replaces it; pass --resume" in told
    assert main([*begin, "--seed", "1", "--resume"]) == 2
    assert "belongs to another fit: seed was 0 and is 1" in capsys.readouterr().err
    assert main([*begin[:-2], "--resume"]) == 2
    assert "--resume needs --checkpoint FILE" in capsys.readouterr().err
