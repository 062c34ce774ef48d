"""Which program is Python, for those who start a process of their own.

`sys.executable` is Python where Python runs. Inside of another program (an application frozen by
PyInstaller, 3D Slicer, QGIS, an embedded Python) it is that program, and to start it would open the
application again.
"""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Any

# python, python3.12, python3.13t, python_d.exe, pythonw.exe, PythonSlicer, pypy3; not pvpython.
_NAME = re.compile(r"(python|pypy)[\w.-]*", re.IGNORECASE)


def python() -> str | None:
    """The path of a Python like the one that runs this, or None where there is none.

    It is the one that `multiprocessing.set_executable` was told of; `sys.executable` where that is
    Python by its name; or one of the same version in the folder of this installation. A frozen
    application has none, but what `set_executable` was told of: its modules are inside of it.
    """
    spawn: Any = sys.modules.get(
        "multiprocessing.spawn"
    )  # who has not imported it has told nothing
    told = spawn and spawn.get_executable()
    told = os.fsdecode(told) if told else None
    if told and told != sys.executable:
        return told
    if getattr(sys, "frozen", False):
        return None
    if sys.executable and is_python(sys.executable):
        return sys.executable
    return next((str(path) for path in _beside() if path.is_file()), None)


def is_python(path: str) -> bool:
    """Whether a program is Python, by its name."""
    return _NAME.fullmatch(re.split(r"[/\\]", path)[-1]) is not None


def _beside() -> list[Path]:
    """Where an installation has its Python, of this very version."""
    major, minor = sys.version_info[:2]
    found = []
    for prefix in dict.fromkeys((sys.prefix, sys.exec_prefix, sys.base_prefix)):
        found.append(Path(prefix, "bin", f"python{major}.{minor}"))
        if Path(prefix, f"python{major}{minor}.dll").is_file():
            found.append(Path(prefix, "python.exe"))
    return found
