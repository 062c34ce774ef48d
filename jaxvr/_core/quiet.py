"""What the command `jaxvr` has to say before JAX is imported.

XLA prints two lines of so-called errors, on tuning features of the processor, for each function
that it loads from its cache. Whether it does is read from the environment when JAX is imported,
which importing this package does; so the command, and nothing else, says no there.
"""

import os
import sys
from pathlib import Path


def is_command(original: list[str], argv: list[str]) -> bool:
    """Whether this process is the command `jaxvr`, or `python -m jaxvr`."""
    if Path(argv[0] if argv else "").stem == "jaxvr":
        return True
    return any(original[k : k + 2] == ["-m", "jaxvr"] for k in (1, 2, 3))


if is_command(sys.orig_argv, sys.argv):
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
