"""A fit's state in one NPZ file: leaves of a pytree bit for bit, losses, and what it belongs to.

The file is written beside its place and moved there, so that an interrupted write leaves the
previous one as it was.
"""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

_FORMAT = "jaxvr fit 1"


def save(path: Any, state: Any, losses: list[float], settings: dict[str, Any]) -> None:
    """Writes the pytree of arrays `state`, the losses so far and JSON-able settings."""
    file = Path(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    leaves, structure = jax.tree.flatten(state)
    about = {"format": _FORMAT, "structure": str(structure), "settings": settings}
    arrays: dict[str, Any] = {f"leaf{k}": np.asarray(x) for k, x in enumerate(leaves)}
    beside = file.with_name(file.name + ".part")
    with open(beside, "wb") as f:
        np.savez(f, about=json.dumps(about), losses=np.asarray(losses, np.float64), **arrays)
    os.replace(beside, file)


def load(path: Any, like: Any, settings: dict[str, Any]) -> tuple[Any, list[float]]:
    """State and losses. Raises ValueError for a file that is none or belongs to another fit.

    `like`: a state of the same structure, shapes and dtypes.
    """
    file = Path(path)
    try:
        # NumPy leaves a file open that it cannot read.
        with open(file, "rb") as f, np.load(f, allow_pickle=False) as data:
            about = json.loads(str(data["about"]))
            losses = [float(x) for x in data["losses"]]
            stored = [data[f"leaf{k}"] for k in range(len(data.files) - 2)]
        if about["format"] != _FORMAT:
            raise ValueError(f"its format is {about['format']!r}")
    except (KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile) as e:
        raise ValueError(f"{str(file)!r} is no checkpoint of a fit ({e}). Delete it.") from e
    leaves, structure = jax.tree.flatten(like)
    differs = [
        f"{key} was {about['settings'].get(key)!r} and is {value!r}"
        for key, value in settings.items()
        if about["settings"].get(key) != value
    ]
    if about["structure"] != str(structure):
        differs.append("optimiser or free parameters are others")
    else:
        differs += [
            f"an array was {a.dtype} {a.shape} and is {b.dtype} {b.shape}"
            for a, b in zip(stored, map(np.asarray, leaves), strict=True)
            if a.shape != b.shape or a.dtype != b.dtype
        ]
    if differs:
        raise ValueError(
            f"The checkpoint {str(file)!r} belongs to another fit: {'; '.join(differs)}. Pass what "
            "it was made with, another file, or resume=False."
        )
    return structure.unflatten([jnp.array(x) for x in stored]), losses
