"""The package as it is installed: what is in the wheel, what importing it loads, what types a
checker sees, and what it says about itself."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

import jaxvr

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
LIMIT = 1_000_000  # bytes of a file


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """The wheel, built as `pip wheel` builds it."""
    folder = tmp_path_factory.mktemp("wheel")
    code = "import sys; from hatchling.build import build_wheel; build_wheel(sys.argv[1])"
    build = [sys.executable, "-c", code, str(folder)]
    if importlib.util.find_spec("hatchling") is None:  # an older environment: pip fetches it
        build = [sys.executable, "-m", "pip", "wheel", "--no-deps", "-w", str(folder), "."]
    done = subprocess.run(build, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """A folder with the wheel's contents, as in site-packages."""
    folder = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as file:
        file.extractall(folder)
    return folder


def run(folder: Path, *arguments: str, cwd: Path) -> str:
    """What a Python says that has `folder` before its other packages."""
    environment = os.environ | {"PYTHONPATH": str(folder)}
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


def sources() -> set[str]:
    """The files of the package, as they lie in the checkout."""
    files = {p for p in (ROOT / "jaxvr").rglob("*") if p.is_file()}
    return {p.relative_to(ROOT).as_posix() for p in files if "__pycache__" not in p.parts}


def test_the_wheel_holds_the_package_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as file:
        sizes = {entry.filename: entry.file_size for entry in file.infolist()}
    about = {name for name in sizes if name.startswith(f"jaxvr-{jaxvr.__version__}.dist-info/")}
    assert set(sizes) - about == sources()
    ours = {"METADATA", "WHEEL", "RECORD", "entry_points.txt", "licenses/LICENSE"}
    assert {name.partition("/")[2] for name in about} == ours
    kinds = {Path(name).suffix for name in set(sizes) - about}
    assert kinds == {".py", ".c", ".h", ".css", ".js", ".typed"}
    assert max(sizes.values()) < LIMIT and "jaxvr/py.typed" in sizes


def test_what_the_wheel_says(installed):
    (about,) = installed.glob("*.dist-info")
    says = Parser().parsestr((about / "METADATA").read_text())
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.M)
    assert cited and says["Version"] == jaxvr.__version__ == cited[1]
    assert says["Requires-Python"] == PROJECT["requires-python"]
    assert "Typing :: Typed" in says.get_all("Classifier", [])
    assert set(says.get_all("Provides-Extra", [])) == set(PROJECT["optional-dependencies"])
    points = (about / "entry_points.txt").read_text()
    assert "jaxvr = jaxvr.cli:main" in points and points.count("jaxvr = jaxvr.accessors") == 2


# What `import jaxvr` may load beside Python and JAX.
LOADED = {"jaxvr", "jax", "numpy", "meshio", "tqdm", "rich", "markdown_it", "mdurl", "pygments"}
ALONE = """
import json, sys
import jax, jax.numpy

before = set(sys.modules)
import jaxvr

more = set(sys.modules) - before
packages = {name.partition(".")[0] for name in more} - sys.stdlib_module_names
packages = [name for name in packages if getattr(sys.modules.get(name), "__file__", None)]

from jaxvr import cli
from jaxvr.interact.widget import Explorer
from jaxvr.native.build import SOURCE

cli.main(["--version"])
files = len(str(Explorer._css)), len(list(SOURCE.glob("*.c")))
print(json.dumps([jaxvr.__file__, packages, len(more), files]))
"""


def test_the_wheel_works_alone_and_importing_it_loads_little(installed, tmp_path):
    """Elsewhere than in the checkout: files beside the modules are found. And a cold import,
    counted: what loads slowly, or may be missing, waits for its first use."""
    version, said = run(installed, "-c", ALONE, cwd=tmp_path).splitlines()
    place, packages, count, files = json.loads(said)
    assert Path(place).is_relative_to(installed) and min(files) > 0
    assert version.startswith(f"jaxvr {jaxvr.__version__} (jax ")
    assert set(packages) <= LOADED, f"import jaxvr loads {set(packages) - LOADED}"
    assert count < 400, f"import jaxvr loads {count} modules beside those of JAX"


ACCESSORS = """
import sys, warnings
warnings.simplefilter("ignore", DeprecationWarning)  # in what PyVista imports
import pyvista
assert "jaxvr" not in sys.modules
grid = pyvista.read(sys.argv[1])
assert "jaxvr" in dir(grid) and "jaxvr" not in sys.modules
print(grid.jaxvr.mesh("density").n_tets, sys.modules["jaxvr"].__file__)
print(pyvista.Plotter(off_screen=True).jaxvr)
"""


def test_pyvista_finds_the_accessors_by_itself(installed, tmp_path):
    """By the entry points of the installed package, with no import of jaxvr, and not before."""
    box = jaxvr.datasets.box((2, 1, 1)).to_pyvista()
    box.rename_array("values", "density")
    box.save(tmp_path / "box.vtu")
    said = run(installed, "-c", ACCESSORS, str(tmp_path / "box.vtu"), cwd=tmp_path).splitlines()
    count, place = said[0].split()
    assert count == "12" and Path(place).is_relative_to(installed)
    assert said[1] == "jaxvr on a plotter: scene, render, screenshot"


SCRIPT = '''
"""A user's script."""

import jax
import numpy as np
import pyvista

import jaxvr
from jaxvr.accessors import GridAccessor

mesh = jaxvr.datasets.box((3, 3, 3))
camera = jaxvr.Camera.orbit(mesh, azimuth=35, width=16, height=16)
transfer = jaxvr.default_transfer(mesh, "turbo")
image = jaxvr.render(mesh, camera, transfer)
picture, status = jaxvr.render(mesh, camera, transfer, status=True)
segments = jaxvr.trace(mesh, camera)
shaded = jaxvr.shade(segments, transfer, integrator=jaxvr.Analytic())
rays = camera.rays()
seen = jaxvr.render_rays(mesh, rays[0], rays[1], transfer)
result = jaxvr.fit(transfer, mesh, [camera], [image], iterations=2, progress=False)
along = jaxvr.probe(mesh, camera, transfer, (8, 8))
colors, extinctions = transfer(mesh.values)
print(np.asarray(image).shape, along[0].lengths, result.loss_history, picture.shape)
score = jaxvr.psnr(image, shaded)


def look(grid: pyvista.UnstructuredGrid) -> jax.Array:
    on_grid: GridAccessor = grid.jaxvr
    return on_grid.render("density")
'''
TYPES = {
    "mesh": "TetMesh",
    "camera": "Camera",
    "transfer": "TransferFunction",
    "image": "Array",
    "picture": "Array",
    "status": "Array",
    "segments": "Segments",
    "shaded": "Array",
    "rays": "tuple[Array, Array]",
    "seen": "Array",
    "result": "FitResult",
    "along": "Probe",
    "colors": "Array",
    "score": "Array",
    "look": "(grid: UnstructuredGrid) -> Array",
}
MISTAKES = {
    "jaxvr.render(mesh, transfer, camera)": "reportCallIssue",
    "image.colour": "reportAttributeAccessIssue",
    "jaxvr.Camera.orbit(mesh, azimut=3)": "reportCallIssue",
}


def test_a_strict_checker_sees_types_and_mistakes(installed, tmp_path):
    """pyright, strict, on a script of somebody who has the wheel."""
    assert len(SCRIPT.strip().splitlines()) >= 20
    asked = [f"reveal_type({name})" for name in TYPES]
    script = "\n".join([SCRIPT, *asked, *(f"print({m})" for m in MISTAKES)])
    (tmp_path / "script.py").write_text(script)
    strict = {"typeCheckingMode": "strict", "pythonVersion": "3.11"}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(strict))
    command = [sys.executable, "-m", "pyright", "--outputjson", "--pythonpath", sys.executable]
    environment = os.environ | {"PYTHONPATH": str(installed)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    found = json.loads(done.stdout)["generalDiagnostics"]
    told = [d["message"] for d in found if d["severity"] == "information"]
    assert told == [f'Type of "{name}" is "{kind}"' for name, kind in TYPES.items()]
    first = len(script.splitlines()) - len(MISTAKES)
    errors = {(d["range"]["start"]["line"], d["rule"]) for d in found if d["severity"] == "error"}
    assert {line for line, _ in errors} == set(range(first, first + len(MISTAKES))), done.stdout
    assert set(enumerate(MISTAKES.values(), first)) <= errors, done.stdout


def test_advice_names_what_can_be_installed():
    """The project is on no index: its extras are had from a checkout, packages by their names."""
    pages = [*ROOT.glob("*.md"), *(ROOT / "notebooks").iterdir(), *(ROOT / "experiments").iterdir()]
    for file in [*(ROOT / "jaxvr").rglob("*.*"), *pages]:
        if file.suffix in (".py", ".md", ".ipynb", ".js", ".c", ".h"):
            text = file.read_text()
            assert not re.search(r"pip3? install (-\S+ )*['\"]?jaxvr\b", text), file


def test_the_policy_names_the_versions_that_are_tested():
    text = (ROOT / "notebooks/contribute.md").read_text().partition("## Supported versions")[2]
    pythons = re.findall(r"Python :: (3\.\d+)$", "\n".join(PROJECT["classifiers"]), re.M)
    assert f"- Python {', '.join(pythons[:-1])} and {pythons[-1]}." in text
    (oldest,) = (m[1] for d in PROJECT["dependencies"] if (m := re.match(r"jax>=([\d.]+)", d)))
    assert f"- JAX {oldest} and newer" in text
    workflow = (ROOT / ".github/workflows/test.yml").read_text()
    assert re.findall(r'version: "(3\.\d+)", jax: (\w+)', workflow) == [
        (p, "oldest" if p == pythons[0] else "newest") for p in pythons
    ]
