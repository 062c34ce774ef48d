"""A new user's first minutes: a fresh environment, the README from the top, each step timed.

    python -m experiments.new_user [--keep FOLDER] [--extras native]

Clones the repository to an empty folder, makes a virtual environment there, installs the package
as its README says, and runs the README's code blocks one after the other as printed.
Downloads are part of the time of the installation.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]

# Runs the blocks in one namespace, and says when each is done.
RUNNER = """
import pathlib, re, sys, time
text = pathlib.Path(sys.argv[1]).read_text()
names = {}
for number, code in enumerate(re.findall(r"^```python\\n(.*?)^```", text, re.M | re.S)):
    start = time.perf_counter()
    exec(compile(code, f"block {number}", "exec"), names)
    print(f"block {number}: {time.perf_counter() - start:.1f} s", flush=True)
    if number == 0:
        print("FIRST PICTURE", flush=True)
"""


def run(folder: Path, extras: str) -> dict[str, Any]:
    """Seconds of each step; raises if one fails."""
    seconds: dict[str, Any] = {}
    start = last = time.perf_counter()

    def step(name: str, command: list[str], **options: Any) -> str:
        nonlocal last
        done = subprocess.run(command, capture_output=True, text=True, **options)
        if done.returncode:
            raise RuntimeError(f"{name} failed:\n{done.stdout}\n{done.stderr}")
        now = time.perf_counter()
        seconds[name], last = now - last, now
        return done.stdout

    checkout, python = folder / "jaxvr", folder / "venv" / "bin" / "python"
    step("clone", ["git", "clone", "--quiet", str(ROOT), str(checkout)])
    step("environment", [sys.executable, "-m", "venv", str(folder / "venv")])
    what = f".[{extras}]" if extras else "."
    step("install", [str(python), "-m", "pip", "install", "--quiet", what], cwd=checkout)
    work = folder / "work"
    work.mkdir()
    readme = str(checkout / "README.md")
    out = step("blocks", [str(python), "-c", RUNNER, readme], cwd=work)
    for number, text in re.findall(r"block (\d+): ([\d.]+) s", out):
        seconds[f"block {number}"] = float(text)
    before = sum(seconds[x] for x in ("clone", "environment", "install"))
    seconds["from clone to the first picture"] = before + seconds["block 0"]
    seconds["in all"] = time.perf_counter() - start
    seconds["files"] = sorted(p.name for p in work.iterdir())
    return seconds


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--keep", type=Path, help="work there, and leave it")
    parser.add_argument("--extras", default="notebooks", help="of the installation")
    found = parser.parse_args(arguments)
    if found.keep:
        found.keep.mkdir(parents=True)
        out = run(found.keep, found.extras)
    else:
        with tempfile.TemporaryDirectory() as folder:
            out = run(Path(folder), found.extras)
    for name, value in out.items():
        print(f"{name:35s} {value if isinstance(value, list) else f'{value:8.1f} s'}")
    return out


if __name__ == "__main__":
    main()
