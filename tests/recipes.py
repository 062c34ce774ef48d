"""What the recipes of notebooks/contribute.md define, as printed there: volumes, tracers and
cameras of another maker, for tests to take. (`test_docs` runs the page as a whole.)"""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path
from types import SimpleNamespace

PAGE = Path(__file__).resolve().parents[1] / "notebooks" / "contribute.md"


@functools.cache
def recipes() -> SimpleNamespace:
    """Classes, functions and constants, without what the page does with them."""
    names: dict[str, object] = {}
    for number, code in enumerate(
        re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.M | re.S)
    ):
        tree = ast.parse(code)
        tree.body = [node for node in tree.body if _defines(node)]
        exec(compile(tree, f"{PAGE.name}, block {number}", "exec"), names)
    return SimpleNamespace(**names)


def _defines(node: ast.stmt) -> bool:
    constant = isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "a").isupper()
    return constant or isinstance(
        node, ast.Import | ast.ImportFrom | ast.ClassDef | ast.FunctionDef
    )


def lengths() -> dict[str, int]:
    """Lines of each block of the page that defines a class, by the name of its last class."""
    found = {}
    for code in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.M | re.S):
        classes = [n.name for n in ast.parse(code).body if isinstance(n, ast.ClassDef)]
        if classes:
            found[classes[-1]] = len(code.splitlines())
    return found
