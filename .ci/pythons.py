"""The other Pythons: for each one that is found an environment of its own, in .venv-3.12 and so on,
and the tests that touch every room with both engines (`pytest -m rooms`, see tests/rooms.py).

    python .ci/pythons.py          # all
    python .ci/pythons.py 3.12     # some
    python .ci/pythons.py --oldest # prints the oldest JAX that pyproject.toml allows, for pip

The oldest Python has the oldest JAX that pyproject.toml allows, the others have the newest. A
version is looked for among the commands (python3.12) and in pyenv's folder, and one that is not
there is named. Fails where a test fails, where the loops in C were not compiled, and where there is
no Python to try.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PROJECT = ROOT / "pyproject.toml"

# What is asked of an environment before its tests: the engine in C is compiled there, here and now,
# and a picture is drawn by it.
ENGINE = """
import platform, jax, jaxvr
jax.config.update("jax_enable_x64", True)
for dtype in ("float32", "float64"):
    missing = jaxvr.native.missing(dtype)
    assert missing is None, missing
    mesh = jaxvr.datasets.box((2, 2, 2), dtype=dtype)
    camera = jaxvr.Camera.orbit(mesh, width=8, height=8)
    transfer = jaxvr.default_transfer(mesh)
    drawn = jax.jit(jaxvr.render).lower(mesh, camera, transfer).as_text()
    assert f"jaxvr_render_{dtype}" in drawn, f"a picture in {dtype} is drawn by JAX's loops"
print(f"Python {platform.python_version()}, jax {jax.__version__}, compiled loops")
"""


def floors() -> list[str]:
    """The oldest JAX that the project allows, as requirements: ["jax==0.7", "jaxlib==0.7"]."""
    needs = tomllib.loads(PROJECT.read_text())["project"]["dependencies"]
    found = [re.match(r"(jax|jaxlib)>=([\d.]+)", need) for need in needs]
    return [f"{match[1]}=={match[2]}" for match in found if match]


def versions() -> list[str]:
    """The Pythons that the project says it runs on, oldest first: ["3.11", ...]."""
    said = tomllib.loads(PROJECT.read_text())["project"]["classifiers"]
    found = [re.fullmatch(r"Programming Language :: Python :: (\d+\.\d+)", line) for line in said]
    return [match[1] for match in found if match]


def find(version: str) -> str | None:
    """A Python of a version that runs and can make environments. (Commands of pyenv may be there
    and only say that the version is not switched on.)"""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    candidates = [shutil.which(f"python{version}"), sys.executable]
    candidates += sorted(map(str, pyenv.glob(f"{version}.*/bin/python3")), reverse=True)
    asks = "import ensurepip, sys, venv; print('%d.%d' % sys.version_info[:2])"
    for path in filter(None, candidates):
        told = subprocess.run([path, "-c", asks], capture_output=True, text=True)
        if told.returncode == 0 and told.stdout.strip() == version:
            return path
    return None


def set_up(version: str, python: str, pins: list[str]) -> Path:
    """The environment's Python. It is made anew where pyproject.toml has changed."""
    folder = ROOT / f".venv-{version}"
    own, stamp = folder / "bin" / "python", folder / ".tools"
    wanted = "\n".join([PROJECT.read_text(), *pins])
    if not stamp.exists() or stamp.read_text() != wanted:
        print(f"Setting up {folder.name} ...", flush=True)
        subprocess.run([python, "-m", "venv", "--clear", folder], check=True)
        pip = [own, "-m", "pip", "--disable-pip-version-check", "--quiet", "install"]
        subprocess.run([*pip, "--no-compile", "--editable", ".[test]", *pins], cwd=ROOT, check=True)
        stamp.write_text(wanted)
    return own


def run(version: str, python: str, pins: list[str]) -> tuple[bool, str]:
    """Whether all is well, and the line that says so."""
    begun = time.monotonic()
    try:
        own = set_up(version, python, pins)
    except subprocess.CalledProcessError as error:
        return False, f"Python {version}: {error}"
    # A cache of its own, so that the library is made by this environment's headers.
    environment = os.environ | {"JAXVR_CACHE": str(own.parents[1] / "loops"), "JAXVR_NATIVE": "1"}
    options = {"cwd": ROOT, "env": environment, "text": True, "stdout": subprocess.PIPE}
    engine = subprocess.run([own, "-W", "error", "-c", ENGINE], **options)
    if engine.returncode:
        return False, f"Python {version}: the loops in C are not used"
    between = time.monotonic()
    tests = [own, "-m", "pytest", "-m", "rooms", "-n", "2", "--dist", "loadscope"]
    last = ""
    with subprocess.Popen(tests, **options) as process:
        for line in process.stdout or ():
            print(line, end="", flush=True)
            last = line.strip() or last
    spent = f"set up in {between - begun:.0f} s, tested in {time.monotonic() - between:.0f} s"
    return process.returncode == 0, f"{engine.stdout.strip()}: {last} ({spent})"


def main(chosen: list[str]) -> int:
    lines, well = [], []
    for version in chosen or versions():
        python = find(version)
        if python is None:
            lines.append(f"Python {version}: not found, not tested")
            continue
        passed, line = run(version, python, floors() if version == versions()[0] else [])
        lines.append(line)
        well.append(passed)
    print("", *lines, sep="\n")
    if not well:
        print(f"None of the Pythons {', '.join(chosen or versions())} was found.")
    return 0 if well and all(well) else 1


if __name__ == "__main__":
    if sys.argv[1:] == ["--oldest"]:
        sys.exit(print(*floors()))
    sys.exit(main(sys.argv[1:]))
