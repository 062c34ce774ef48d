"""Tests on data that are not in the repository run where the data are, and elsewhere are left out.

A test names its files: `@pytest.mark.outside("can.vtu")`, or `"vectors/NAME"` for one of the
reference segments, and gets their paths from the fixture `data_path`. `experiments/data.py` says
which folders these are.

Folder not there: its tests are left out, and counted in the closing lines; with `CI=true` it is an
error of the session, unless `JAXVR_DATA=none` says that this is meant. File not there, in a folder
that is: the test fails. What takes the place of such files anywhere is in `stand_ins`.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import pytest

from experiments.data import VARIABLES, folder, locate, path_of

lacking: dict[str, int] = {}  # "tests", and for each file the tests that need it


def is_there(kind: str) -> bool:
    place = folder(kind)
    return place is not None and place.is_dir()


@pytest.fixture(scope="session")
def data_path():
    """Path of a file of the outside data; the test fails, loudly, where it is missing."""

    def find(name: str) -> Path:
        try:
            return path_of(name)
        except FileNotFoundError as error:
            pytest.fail(str(error))

    return find


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "outside(*names): needs files not in the repository")
    lacking.clear()
    if hasattr(config, "workerinput") or os.environ.get("CI", "").lower() not in ("true", "1"):
        return
    for kind, variable in VARIABLES.items():
        if folder(kind) is not None and not is_there(kind):
            raise pytest.UsageError(
                f"CI is set, and the folder of the outside {kind}, {folder(kind)}, is not there: "
                f"set {variable} to it, or JAXVR_DATA=none to leave out the tests that need it."
            )


@pytest.hookimpl(trylast=True)  # what was not chosen is not counted
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    kept, dropped, counts = [], [], Counter()
    for item in items:
        names = {name for mark in item.iter_markers("outside") for name in mark.args}
        if not names and "data_path" in getattr(item, "fixturenames", ()):
            raise pytest.UsageError(f"{item.nodeid} needs @pytest.mark.outside(names of its files)")
        missing = sorted(name for name in names if not is_there(locate(name)[0]))
        counts.update(missing)
        (dropped if missing else kept).append(item)
    if dropped:
        lacking.update(counts, tests=len(dropped))
        config.hook.pytest_deselected(items=dropped)
        items[:] = kept


def pytest_sessionfinish(session: pytest.Session) -> None:
    output = getattr(session.config, "workeroutput", None)
    if output is not None:  # a worker of pytest-xdist: the main process tells
        output["outside"] = dict(lacking)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node, error) -> None:
    """Each worker collects all tests, so that each has the same counts."""
    lacking.update(getattr(node, "workeroutput", {}).get("outside", {}))


def pytest_terminal_summary(terminalreporter) -> None:
    if lacking:
        terminalreporter.write_line(told(lacking))


def told(counts: Mapping[str, int]) -> str:
    files = {name: n for name, n in counts.items() if name != "tests"}
    ordered = sorted(files.items(), key=lambda item: (-item[1], item[0]))
    variables = sorted({VARIABLES[locate(name)[0]] for name in files})
    return (
        f"left out: {counts['tests']} tests, which need "
        f"{', '.join(f'{name} ({n})' for name, n in ordered)}: set {' and '.join(variables)}"
    )
