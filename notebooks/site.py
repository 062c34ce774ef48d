"""Collects the pages of the documentation, laid out as in the repository, for mkdocs to build.

    python -m notebooks.site       # to output/docs; `make docs` builds output/site from it

Pages are the README, what stands in notebooks/ and experiments/, and a reference that lists each
public name by room; its text is the docstrings, so there is nothing to keep in step.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import re
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SUFFIXES = {".md", ".ipynb", ".png", ".gif", ".json", ".cff"}
# Pages of the reference, in order: their titles, and of which modules the public names are.
PAGES = {
    "Rendering": ("render", "probe", "hints", "_core", "defaults"),
    "Volumes": ("volume",),
    "Cameras and pictures": ("view", "files"),
    "Transfer functions and integrators": ("optics",),
    "Tracers and orders": ("trace", "order"),
    "Compositors, adjoints and engines": ("composite", "adjoint", "engine", "native"),
    "Fitting": ("fit",),
    "Plots": ("plot",),
    "Notebooks": ("interact",),
    "Testing": ("testing",),
}
# What users subclass or are given, but do not import from the top.
MORE = {
    "Volumes": ("jaxvr.volume.readers.Field",),
    "Transfer functions and integrators": (
        "jaxvr.optics.integrator.AbstractIntegrator",
        "jaxvr.optics.integrator.AbstractSlabIntegrator",
    ),
    "Tracers and orders": ("jaxvr.trace.base.AbstractTracer", "jaxvr.trace.recorded.Recorded"),
    "Compositors, adjoints and engines": (
        "jaxvr.composite.base.AbstractCompositor",
        "jaxvr.adjoint.base.AbstractAdjoint",
    ),
    "Notebooks": ("jaxvr.interact.widget.Explorer",),
}


def public() -> dict[str, list[str]]:
    """Dotted names of everything public, by page of the reference."""
    import jaxvr
    import jaxvr.plot

    page_of = {room: page for page, rooms in PAGES.items() for room in rooms}
    found: dict[str, list[str]] = {page: [] for page in PAGES}
    for name in jaxvr.__all__:
        thing = getattr(jaxvr, name)
        if inspect.ismodule(thing):
            room = thing.__name__.split(".")[1]
            names = [f"{thing.__name__}.{x}" for x in getattr(thing, "__all__", ())]
            found[page_of[room]] += names or [thing.__name__]
        else:
            found[page_of[thing.__module__.split(".")[1]]].append(where(thing))
    found["Plots"] += [where(getattr(jaxvr.plot, x)) for x in jaxvr.plot.__all__]
    fitting = importlib.import_module("jaxvr.fit")  # `jaxvr.fit` is the function
    names = [where(getattr(fitting, x)) for x in fitting.__all__]
    found["Fitting"] += [x for x in names if x not in found["Fitting"]]
    for page, names in MORE.items():
        found[page] += names
    return found


def where(thing: Any) -> str:
    """The dotted name under which a class or function is defined."""
    return f"{thing.__module__}.{thing.__qualname__}"


def collect(out: Path) -> None:
    """Writes all pages to a folder, which is made anew."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    text = (ROOT / "README.md").read_text()
    (out / "index.md").write_text(text)
    shutil.copy(ROOT / "CITATION.cff", out / "CITATION.cff")
    for folder in ("notebooks", "experiments"):
        for file in (ROOT / folder).iterdir():
            if file.suffix in SUFFIXES:
                (out / folder).mkdir(exist_ok=True)
                shutil.copy(file, out / folder / file.name)
    reference = out / "reference"
    reference.mkdir()
    for page, names in public().items():
        lines = [f"# {page}", ""]
        for name in names:
            lines += [f"::: {name}", ""]
        file = reference / f"{page.lower().replace(' ', '_')}.md"
        file.write_text("\n".join(lines))


# One or more names, perhaps with a shape and a dtype, and a colon.
_SHAPE = r"(?: \([^()]*\))?(?: [a-z]+\d+)?"


def listed(text: str, names: Iterable[str]) -> str:
    """A docstring with an entry of a list for each description of one of the names.

    Classes and functions here describe fields and arguments in running text, `name: what it is.
    next (N, 3): ...`, which is short to read in an editor and would run together in Markdown.
    names: those of the class's or function's own fields or arguments.
    """
    name = "|".join(sorted(map(re.escape, names), key=len, reverse=True))
    if not name:
        return text
    one = rf"(?:{name}){_SHAPE}"
    label = re.compile(rf"(?:(?<=^)|(?<=\n)|(?<=[.;] ))({one}(?:(?:,| and) {one})*): ")
    return "\n\n".join(_paragraph(x, label) for x in text.split("\n\n"))


def _paragraph(text: str, label: re.Pattern[str]) -> str:
    # Sections ("Raises:"), code and tables are as they are.
    if re.match(r"[A-Z]\w+:\n|    |```|\||>>> ", text):
        return text
    before, *parts = label.split(text)
    entries = [
        f"- `{x}`: {' '.join(y.split())}" for x, y in zip(parts[::2], parts[1::2], strict=True)
    ]
    head = [before.strip()] if before.strip() else []
    return "\n\n".join([*head, "\n".join(entries)]) if entries else text


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "output" / "docs")
    collect(parser.parse_args(arguments).out)


if __name__ == "__main__":
    main()
