"""The notebooks, cell by cell at small size, in this process, so that compiled code is shared."""

from __future__ import annotations

import json
import re
from typing import Any

import jax
import pytest
from IPython.core.interactiveshell import InteractiveShell
from IPython.utils.capture import capture_output

from notebooks.run import BYTES, notebooks, smaller

pytestmark = pytest.mark.usefixtures("quick_jit")


@pytest.fixture
def shell():
    """A fresh IPython, without a terminal or a history."""
    InteractiveShell.clear_instance()
    shell: Any = InteractiveShell.instance()
    shell.display_formatter.active_types = ["text/plain", "text/html", "image/png"]
    yield shell
    shell.run_line_magic("unload_ext", "jaxvr")
    InteractiveShell.clear_instance()
    jax.config.update("jax_enable_x64", True)


@pytest.mark.parametrize("path", notebooks(), ids=lambda p: p.stem)
def test_notebooks_run(path, shell, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pictures = 0
    for cell in json.loads(path.read_text())["cells"]:
        code = "".join(cell["source"])
        if cell["cell_type"] != "code":
            continue
        if "parameters" in cell["metadata"].get("tags", ()):
            code = smaller(code)
        with capture_output() as said:
            result = shell.run_cell(code)
            shown, _ = shell.display_formatter.format(result.result)
        if result.error_before_exec or result.error_in_exec:
            pytest.fail(f"{code}\n{said.stdout}")
        pictures += "image/png" in shown
    assert pictures, "a notebook without pictures"


@pytest.mark.parametrize("path", notebooks(), ids=lambda p: p.stem)
def test_notebooks_are_committed_as_they_run(path):
    """With the outputs of each cell, in order, none of them an error, and not too large."""
    text = path.read_text()
    cells = [c for c in json.loads(text)["cells"] if c["cell_type"] == "code"]
    assert [c["execution_count"] for c in cells] == list(range(1, len(cells) + 1))
    kinds = {x["output_type"] for c in cells for x in c["outputs"]}
    assert "error" not in kinds
    assert not any(x.get("name") == "stderr" for c in cells for x in c["outputs"])
    assert "image/png" in text and len(text) < BYTES
    assert not re.search(r"/(tmp|root|home|work)/", text), "a path of the machine that ran it"
