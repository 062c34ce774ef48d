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


def room_of(path: Path) -> str:
    return path.parts[0].removesuffix(".py")


def imports(path: Path):
    """Modules of jaxvr that a file imports anywhere, as ('room', line)."""
    for node in ast.walk(ast.parse((ROOT / path).read_text())):
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
