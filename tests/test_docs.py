"""What users read: every code block works as printed, every link leads somewhere, and every public
name is documented."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import json
import re
import shlex
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import meshio
import numpy as np
import pytest

import jaxvr
import jaxvr.accessors  # which PyVista finds by itself where jaxvr is installed: see test_package
import jaxvr.plot
from jaxvr import cli
from jaxvr.adjoint.base import AbstractAdjoint
from jaxvr.composite import AbstractCompositor
from jaxvr.engine import AbstractEngine
from jaxvr.optics import AbstractIntegrator
from jaxvr.order import AbstractOrder
from jaxvr.trace.base import AbstractTracer
from notebooks.site import collect, listed, public

ROOT = Path(__file__).resolve().parents[1]
OTHERS = sorted([*ROOT.glob("notebooks/*.md"), *ROOT.glob("experiments/*.md")])
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *OTHERS]
NOTEBOOKS = sorted(ROOT.glob("notebooks/*.ipynb"))
GUIDES = [p for p in PAGES if p.parent.name != "experiments"]


def blocks(page: Path, language: str) -> list[str]:
    """The code blocks of a page in one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.M | re.S)


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("page", [p for p in GUIDES if blocks(p, "python")], ids=name_of)
def test_code_blocks_run_as_printed(page, tmp_path, monkeypatch, quick_jit):
    """One after the other, as somebody does who copies them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    update = importlib.import_module("jax").config.update
    kept = {"jax_compilation_cache_dir": None, "jax_persistent_cache_min_compile_time_secs": 1.0}
    names: dict[str, object] = {}
    try:
        for number, code in enumerate(blocks(page, "python")):
            exec(compile(code, f"{page.name}, block {number}", "exec"), names)
    finally:
        for key, value in kept.items():
            update(key, value)
        update("jax_enable_x64", True)


def test_layers_of_the_page_on_xarray():
    """Its functions on faces with 3 to 6 corners: volumes of columns, and what stands for none."""
    names: dict[str, Any] = {"np": np}
    for code in blocks(ROOT / "notebooks" / "from_xarray.md", "python"):
        if "\ndef " in f"\n{code}":
            exec(code, names)
    angles = [2 * np.pi * np.arange(n) / n for n in (3, 4, 5, 6)]
    x = np.concatenate([3 * k + np.cos(a) for k, a in enumerate(angles)])
    y = np.concatenate([np.sin(a) for a in angles])
    faces = np.full((4, 6), -1)
    for k, first in enumerate((0, 3, 7, 12)):
        faces[k, : k + 3] = first + np.arange(k + 3)
    height = np.array([0.0, 0.5, 2.0])[:, None] + 0.1 * x
    points, cells, which = names["columns"](x, y, faces, height)
    of_face = {kind: np.broadcast_to(at, c.shape[:2]).ravel() for (kind, at), c in zip(
        which.items(), (cells[k] for k in which), strict=True)}  # fmt: skip
    flat = {kind: c.reshape(-1, c.shape[-1]) for kind, c in cells.items()}
    mesh = jaxvr.TetMesh.from_cells(points, flat, of_face, location="cell", dtype="float64")
    corners = np.asarray(mesh.points)[np.asarray(mesh.cells)]
    volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6
    found = np.bincount(np.asarray(mesh.values).astype(int), volumes)
    want = [2 * n * np.sin(2 * np.pi / n) / 2 for n in (3, 4, 5, 6)]
    np.testing.assert_allclose(found, want, rtol=1e-12)

    def variable(values, **about):
        return SimpleNamespace(values=np.asarray(values), attrs=about)

    ones = np.where(faces < 0, -999, faces + 1)
    nan = np.where(faces < 0, np.nan, faces + 1)
    least, most = (np.where(faces < 0, end, faces) for end in (-(2**63), 2**31 - 1))
    for given in (
        variable(ones, start_index=1, _FillValue=-999),
        variable(nan, start_index=1),
        variable(np.where(faces < 0, 0, faces + 1), start_index=1, _FillValue=0),
        variable(least, _FillValue=-(2**63)),
        variable(most, _FillValue=2**31 - 1),
        variable(faces),
    ):
        np.testing.assert_array_equal(names["faces_of"](given), faces)


def test_commands_of_the_readme_run_as_printed(tmp_path, monkeypatch, capsys, quick_jit):
    monkeypatch.chdir(tmp_path)
    mesh = jaxvr.datasets.box((3, 3, 3))
    data: dict[str, Any] = {"cells": {"tetra": np.asarray(mesh.cells)}}
    data |= {"point_data": {"density": np.asarray(mesh.values)}}
    meshio.Mesh(np.asarray(mesh.points), **data).write("file.vtu")
    commands = [
        line
        for block in blocks(ROOT / "README.md", "sh")
        for line in block.splitlines()
        if line.startswith("jaxvr ")
    ]
    assert len(commands) == 3
    for command in commands:
        assert cli.main(shlex.split(command)[1:]) == 0, capsys.readouterr().err
    assert (tmp_path / "picture.png").stat().st_size > 10_000
    assert (tmp_path / "folder" / "transfer.json").exists()


@pytest.mark.parametrize("page", [*PAGES, *NOTEBOOKS], ids=name_of)
def test_what_commands_name_exists(page):
    """Targets of `make`, modules of `python -m` and extras of `pip install`."""
    text = page.read_text()
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.M)
    shell = "".join(blocks(page, "sh"))
    if page.suffix == ".md":  # where what is indented is code, too
        shell += "".join(re.findall(r"^    .*\n", text, re.M))
    for name in re.findall(r"^ *make (\w+)", shell, re.M) + re.findall(r"`make (\w+)", text):
        assert name in targets, f"{page.name}: make {name}"
    for name in re.findall(r"python -m ((?:experiments|notebooks)\.\w+)", text):
        assert importlib.util.find_spec(name), f"{page.name}: python -m {name}"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    for names in re.findall(r"pip install '(?:jaxvr|\.)\[([^\]]*)\]'", text):
        known = set(project["optional-dependencies"])
        assert set(names.split(",")) <= known, f"{page.name}: {names}"


def prose(page: Path) -> str:
    """What is written on a page or in a notebook, without code."""
    text = page.read_text()
    if page.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        text = "\n\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
    return re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)


def anchors(page: Path) -> set[str]:
    """Anchors of the headings, as repository pages make them."""
    headings = re.findall(r"^#+ +(.*)$", prose(page), re.M)
    return {re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in headings}


@pytest.mark.parametrize("page", [*PAGES, *NOTEBOOKS], ids=name_of)
def test_links_lead_somewhere(page):
    for text, target in re.findall(r"\[([^\]]*)\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        at = (page.parent / file).resolve() if file else page
        assert at.exists(), f"{page.name}: [{text}]({target})"
        if anchor:
            assert anchor in anchors(at), f"{page.name}: [{text}]({target})"


def test_every_experiment_and_notebook_is_linked():
    text = "".join(p.read_text() for p in PAGES)
    for file in [*NOTEBOOKS, *OTHERS]:
        assert file.name in text, f"no page links to {file.name}"


def resolve(dotted: str):
    """The module, class or function of a dotted name."""
    parts = dotted.split(".")
    for cut in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:cut]))
        except ImportError:
            continue
        for part in parts[cut:]:
            found = getattr(found, part)
        return found
    raise AssertionError(dotted)


PUBLIC = sorted({name for names in public().values() for name in names})
# What renderers call, and users do not: bases describe the arguments, by their shapes.
SWAPPED = (
    *(AbstractTracer, AbstractIntegrator, AbstractAdjoint, AbstractOrder, AbstractCompositor),
    AbstractEngine,
)


@pytest.mark.parametrize("dotted", PUBLIC)
def test_public_names_are_documented(dotted):
    """The thing itself, its methods and properties, and each argument by its name."""
    thing = resolve(dotted)
    text = inspect.getdoc(thing) or ""
    assert len(text) > 20, f"{dotted} has no docstring"
    if inspect.isfunction(thing):
        require_arguments(dotted, thing, text)
    if not inspect.isclass(thing):
        return
    for name, member in vars(thing).items():
        if name.startswith("_") or name.startswith("tree_"):
            continue
        function = getattr(member, "__func__", member)
        if isinstance(member, property):
            assert inspect.getdoc(member), f"{dotted}.{name} has no docstring"
        elif inspect.isfunction(function):
            own = inspect.getdoc(getattr(thing, name)) or ""
            by_module = f"`{name}(" in (inspect.getdoc(inspect.getmodule(thing)) or "")
            assert own or by_module, f"{dotted}.{name} has no docstring"
            if not issubclass(thing, SWAPPED):
                require_arguments(f"{dotted}.{name}", function, own + text)


def require_arguments(dotted, function, text):
    module = inspect.getmodule(function)
    assert module is not None
    room = importlib.import_module(".".join(module.__name__.split(".")[:2]))
    pages = text + (inspect.getdoc(module) or "") + (inspect.getdoc(room) or "")
    for other in re.findall(r"as (?:for )?`(\w+)`", text):
        pages += inspect.getdoc(getattr(jaxvr, other, getattr(jaxvr.plot, other, None))) or ""
    for other in re.findall(r"see `(jaxvr\.[\w.]+)`", text):
        pages += inspect.getdoc(resolve(other)) or ""
    for name, parameter in inspect.signature(function).parameters.items():
        many = parameter.kind in (parameter.VAR_KEYWORD, parameter.VAR_POSITIONAL)
        if name not in ("self", "cls") and not many:
            assert re.search(rf"\b{name}\b", pages), f"{dotted}: nothing is said of {name!r}"


def test_fields_become_lists_on_the_site():
    text = "What it is: this.\n\nx, y (N, 3): where\nit is. z: how\nhigh.\n\nRaises:\n  z: no."
    assert listed(text, ["x", "y", "z", "is"]) == (
        "What it is: this.\n\n- `x, y (N, 3)`: where it is.\n- `z`: how high.\n\nRaises:\n  z: no."
    )
    assert listed(text, []) == text


def test_the_site_has_all_pages(tmp_path):
    collect(tmp_path / "docs")
    reference = "".join(p.read_text() for p in (tmp_path / "docs" / "reference").iterdir())
    for dotted in PUBLIC:
        assert f"::: {dotted}\n" in reference
    assert (tmp_path / "docs" / "notebooks" / "choices.md").exists()
