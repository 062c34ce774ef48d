"""JAX's own cache of compiled functions, for programs that start anew for each picture.

Compiled functions are code that a process will run. They go to a folder beside the libraries of
`cache`, by the same rule: one that only this user, or root, can write to, else there is no cache.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import jax

from jaxvr.native import cache
from jaxvr.native.build import cache_folder

FOLDER = "xla"
# Below this many seconds to compile, reading is no quicker.
LEAST = 0.1


def switch_on() -> Path | None:
    """Keeps what this process compiles, and takes what others have; where, or None.

    Nothing is changed where the user has chosen: a folder of JAX's own (JAX_COMPILATION_CACHE_DIR),
    or none (JAX_ENABLE_COMPILATION_CACHE). Warns where there is no folder that is safe. The lines
    that XLA then prints are switched off for the command by `_core.quiet`.
    """
    config: Any = jax.config
    if config.jax_compilation_cache_dir or not config.jax_enable_compilation_cache:
        return None
    try:
        folder = cache.prepare(cache.prepare(cache_folder()[0]) / FOLDER)
    except OSError as error:
        warnings.warn(f"Compiled functions are not kept: {error}", UserWarning, stacklevel=2)
        return None
    config.update("jax_compilation_cache_dir", str(folder))
    config.update("jax_persistent_cache_min_compile_time_secs", LEAST)
    return folder
