"""Which modules the workers of pytest-xdist take first: the slowest, so that none of them is left
to one worker at the end while the other has nothing to do. (By itself `loadscope` begins with those
that have most tests; the Makefile's `--no-loadscope-reorder` leaves the order to this.)"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

HERE = Path(__file__).parent
# Half a minute and more each; the others follow by their number of tests.
SLOWEST = (
    "test_registry.py",
    "test_experiments.py",
    "test_notebooks.py",
    "trace/test_flat_kbuffer.py",
    "trace/test_interval.py",
    "test_recipes.py",
    "test_docs.py",
    "test_state_machine.py",
    "composite/test_projections.py",
    "trace/test_nasty_meshes.py",
    "trace/test_kbuffer.py",
)


@pytest.hookimpl(trylast=True)  # pytest has put tests with the same fixtures side by side by then
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if not hasattr(config, "workerinput"):
        return
    missing = [name for name in SLOWEST if not (HERE / name).exists()]
    if missing:
        raise pytest.UsageError(f"tests/schedule.py names what is not there: {missing}")
    first = {HERE / name: i for i, name in enumerate(SLOWEST)}
    tests = Counter(item.path for item in items)
    items.sort(key=lambda item: (first.get(item.path, len(first)), -tests[item.path], item.path))
