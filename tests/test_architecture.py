"""The house: rooms import only from those before them, and only one room has custom_vjp."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import jaxvr

ROOT = Path(jaxvr.__file__).parent
ROOMS = [
    "_core", "numerics", "volume", "view", "optics", "order", "trace", "composite", "native",
    "adjoint", "engine", "arguments", "units", "defaults", "hints", "render", "probe", "fit",
    "shard", "files", "testing", "plot", "pictures", "interact", "accessors", "cli", "__main__",
]  # fmt: skip
FILES = sorted(p.relative_to(ROOT) for p in ROOT.rglob("*.py") if p.name != "__init__.py")


# Imports of a lower room, from a function's body: files, functions and the rooms they look up to.
UPWARDS = {("volume/mesh.py", "default_tracer", "trace")}
# Names of types alone, of which nothing is left when the code runs.
TYPES = {("volume/base.py", "trace"), ("volume/mesh.py", "trace")}


def room_of(path: Path) -> str:
    return path.parts[0].removesuffix(".py")


def imports(path: Path):
    """Modules of jaxvr that a file imports anywhere, as ('room', line), but for the exceptions."""
    tree = ast.parse((ROOT / path).read_text())
    excepted = {id(node) for node in ast.walk(tree) if _is_excepted(path, node, tree)}
    for node in ast.walk(tree):
        if id(node) in excepted:
            continue
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = ["jaxvr", *path.parts[: len(path.parts) - node.level]]
                base = ".".join([*above, base]).rstrip(".")
            names = [f"{base}.{alias.name}" for alias in node.names]
        else:
            continue
        for name in names:
            parts = name.split(".")
            if parts[0] == "jaxvr" and len(parts) > 1:
                yield parts[1], node.lineno


def _is_excepted(path: Path, node: ast.AST, tree: ast.AST) -> bool:
    if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("jaxvr."):
        return False
    room = str(node.module).split(".")[1]
    for outer in ast.walk(tree):
        if node not in list(ast.walk(outer)):
            continue
        if isinstance(outer, ast.FunctionDef) and (path.as_posix(), outer.name, room) in UPWARDS:
            return True
        types = isinstance(outer, ast.If) and getattr(outer.test, "id", "") == "TYPE_CHECKING"
        if types and (path.as_posix(), room) in TYPES:
            return True
    return False


def test_exceptions_are_in_use():
    found = {
        (path.as_posix(), outer.name, str(node.module).split(".")[1])
        for path in {Path(name) for name, _, _ in UPWARDS}
        for outer in ast.walk(ast.parse((ROOT / path).read_text()))
        if isinstance(outer, ast.FunctionDef)
        for node in ast.walk(outer)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("jaxvr.")
    }
    assert UPWARDS <= found


def test_volumes_are_told_apart_in_few_places():
    """Others ask a volume what it is asked for in `AbstractVolume`, whatever class it is of."""
    allowed = {"trace/measure.py", "order/exact.py"}  # views of faces of cells
    for path in FILES:
        if room_of(path) == "volume" or path.as_posix() in allowed:
            continue
        for node in ast.walk(ast.parse((ROOT / path).read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in (
                "isinstance",
                "require_kind",
            ):
                names = {getattr(x, "id", "") for x in ast.walk(node)}
                assert "TetMesh" not in names, f"{path}:{node.lineno}"


@pytest.mark.parametrize("path", FILES, ids=str)
def test_rooms_import_from_above(path):
    mine = ROOMS.index(room_of(path))
    for room, line in imports(path):
        if room in ROOMS:
            assert ROOMS.index(room) <= mine, f"{path}:{line} imports from {room}"


def test_nothing_imports_from_testing():
    for path in FILES:
        rooms = {room for room, _ in imports(path)}
        assert room_of(path) == "testing" or "testing" not in rooms, path


def test_custom_vjp_stands_in_adjoint_only():
    for path in FILES:
        for node in ast.walk(ast.parse((ROOT / path).read_text())):
            name = getattr(node, "attr", getattr(node, "id", None))
            if isinstance(node, ast.Attribute | ast.Name) and name in ("custom_vjp", "defvjp"):
                assert room_of(path) == "adjoint", f"{path}:{node.lineno}"


def test_matplotlib_stands_in_plot_only():
    for path in FILES:
        if "matplotlib" in (ROOT / path).read_text() and path.name != "colormaps.py":
            uses = [n for n in ast.walk(ast.parse((ROOT / path).read_text())) if _is_mpl(n)]
            assert not uses or room_of(path) == "plot", path


def _is_mpl(node) -> bool:
    if isinstance(node, ast.Import):
        return any(a.name.startswith("matplotlib") for a in node.names)
    return isinstance(node, ast.ImportFrom) and (node.module or "").startswith("matplotlib")


PUBLIC = """
TetMesh read_mesh write_mesh read_plot3d Camera TransferFunction render render_rays trace
shade fit psnr ssim datasets Analytic PartialPreIntegration PreIntegration Quadrature AverageColor
ConstantExtinction RayCast KBuffer measure_k rasterize refine order Over Replay Direct Forward check
probe engine default_transfer save_image turntable explore MaximumIntensity XRay
""".split()


def test_public_names():
    for name in PUBLIC:
        assert hasattr(jaxvr, name), name
        assert name in jaxvr.__all__
    for name in jaxvr.__all__:
        assert getattr(jaxvr, name).__doc__, name


def test_every_room_says_what_it_is():
    for init in ROOT.rglob("__init__.py"):
        assert len(ast.get_docstring(ast.parse(init.read_text())) or "") > 40, init
