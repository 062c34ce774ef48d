"""Runs the notebooks from top to bottom and keeps their pictures, as they are committed.

    python -m notebooks.run [NAME ...]      # `make notebooks`

Each in a kernel of its own, in an empty folder. Prints how long the slowest cell took, and fails if
that is longer than a user would wait (`SECONDS`). The first cell is tagged `parameters`; tests run
the same cells with smaller ones (`SMALL`).
"""

from __future__ import annotations

import argparse
import re
import tempfile
import time
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).resolve().parent
SMALL = {"SIZE": 32, "ITERATIONS": 4, "CELLS": (4, 14, 2), "FEWER": (2,)}
# What a notebook may weigh, with its pictures.
BYTES = 3_000_000
# What a cell may take, on two cores.
SECONDS = 30


def notebooks() -> list[Path]:
    """All of them, in order."""
    return sorted(FOLDER.glob("[0-9]*_*.ipynb"))


def smaller(code: str) -> str:
    """The code of the cell with parameters, with those of tests."""
    for name, value in SMALL.items():
        code = re.sub(rf"^{name} = .*?(?=  #|$)", f"{name} = {value}", code, flags=re.M)
    return code


def run(path: Path) -> list[float]:
    """Runs a notebook and writes it back; the seconds of each cell."""
    import nbformat  # pyright: ignore[reportMissingImports]
    from nbclient import NotebookClient  # pyright: ignore[reportMissingImports]

    book = nbformat.read(path, as_version=4)
    seconds: list[float] = []
    started = 0.0

    def begin(**_: Any) -> None:
        nonlocal started
        started = time.perf_counter()

    def end(**_: Any) -> None:
        seconds.append(time.perf_counter() - started)

    with tempfile.TemporaryDirectory() as folder:
        client = NotebookClient(
            book,
            timeout=300,
            resources={"metadata": {"path": folder}},
            on_cell_execute=begin,
            on_cell_executed=end,
        )
        client.execute()
    for cell in book.cells:
        cell.metadata.pop("execution", None)  # times of day, which would differ each time
    book.metadata.pop("widgets", None)
    nbformat.write(book, path)
    return seconds


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", help="parts of their names; all if none")
    names = parser.parse_args(arguments).names
    for path in notebooks():
        if names and not any(name in path.name for name in names):
            continue
        seconds, size = run(path), path.stat().st_size
        slowest = f"slowest cell {max(seconds):5.1f} s"
        print(f"{path.name:28s} {sum(seconds):6.1f} s, {slowest}, {size:,} bytes", flush=True)
        if max(seconds) > SECONDS:
            raise SystemExit(f"A cell of {path.name} takes too long: {SECONDS} s are allowed.")
        if size > BYTES:
            raise SystemExit(f"{path.name} is too large: {size:,} bytes, {BYTES:,} allowed.")


if __name__ == "__main__":
    main()
