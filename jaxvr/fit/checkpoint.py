"""A fit's state in one file: leaves of a pytree bit for bit, losses, and what it belongs to.

The file is a ZIP archive without compression, which `numpy.load` reads: `about.json`, `losses.npy`
and `leaf0.npy`, `leaf1.npy`, ... Its checksums tell whether it is whole. Sizes are compared with
the file's and with what is to come before anything is read, so that no file asks for more memory
than it has itself.
"""

from __future__ import annotations

import json
import math
import os
import re
import stat
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxvr._core.writing import place_of, shown, whole_file
from jaxvr.fit.differences import differences
from jaxvr.fit.digest import plain, raw

_FORMAT = "jaxvr fit 2"
_SLACK = 4096  # bytes that the header of an array may take
_MOST = 1 << 26  # bytes of about.json
_HEADER = re.compile(
    rb"\{'descr': '([<>|]?[a-z]\d+)', 'fortran_order': False, 'shape': \(([\d, ]*)\), \}\s*"
)


def save(path: Any, state: Any, losses: list[float], about: dict[str, Any]) -> None:
    """Writes the pytree of arrays `state`, the losses so far, and what they belong to, which JSON
    can hold: see `differences`. Raises OSError; then the previous file is as it was."""
    file = place_of(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    leaves, structure = jax.tree.flatten(state)
    head = {
        "format": _FORMAT,
        "iterations": len(losses),
        "structure": plain(structure),
        "leaves": [_kind(x) for x in leaves],
        "about": about,
    }
    with (
        whole_file(file) as out,
        zipfile.ZipFile(out, "w", zipfile.ZIP_STORED, allowZip64=True) as archive,
    ):
        archive.writestr(_entry("about.json"), json.dumps(head))
        for name, x in [("losses", np.asarray(losses, np.float64)), *_named(leaves)]:
            with archive.open(_entry(f"{name}.npy"), "w", force_zip64=True) as part:
                np.lib.format.write_array(part, _bits(x), allow_pickle=False)


def load(
    path: Any, like: Any, about: dict[str, Any] | Callable[[int], dict[str, Any]]
) -> tuple[Any, list[float]]:
    """State and losses.

    like: a state of the same structure, shapes and dtypes. about: as for `save`, or a function from
    the number of iterations to it.

    Raises ValueError for a file that is no whole checkpoint, and for one of another fit, with what
    differs; OSError for one that cannot be opened. Warns with a `CheckpointWarning` of one that was
    made by other versions or on another machine.
    """
    file = place_of(path)
    leaves, structure = jax.tree.flatten(like)
    kinds = [_kind(x) for x in leaves]
    with _opened(file) as stream:
        try:
            size = os.fstat(stream.fileno()).st_size
            with zipfile.ZipFile(stream) as archive:
                head = _head(archive, size)
                losses = _array(archive, "losses", np.dtype("f8"), (head["iterations"],), size)
                said = [f"{a[0]} {tuple(a[1])}" for a in head["leaves"]]
        except Exception as e:
            raise _none(file, _reason(e)) from e
        now = about(len(losses)) if callable(about) else about
        unlike = []
        if head["structure"] != plain(structure) or len(said) != len(kinds):
            unlike.append("the optimiser or the free parameters are others")
        else:
            wanted = [f"{b[0]} {tuple(b[1])}" for b in kinds]
            unlike += [
                f"an array was {a} and is {b}" for a, b in zip(said, wanted, strict=True) if a != b
            ]
        differences(file, head["about"], now, unlike)
        try:
            with zipfile.ZipFile(stream) as archive:
                stored = [
                    _array(archive, f"leaf{k}", _bits(x).dtype, _bits(x).shape, size)
                    for k, x in enumerate(leaves)
                ]
        except Exception as e:
            raise _none(file, _reason(e)) from e
    made = [_leaf(x, a, b) for x, a, b in zip(stored, leaves, head["leaves"], strict=True)]
    return structure.unflatten(made), [float(x) for x in losses]


def require_replaceable(path: Any) -> int:
    """Iterations in the checkpoint that stands there, 0 if there is no file or an empty one.

    ValueError if a file stands there that is none: it is not to be overwritten by mistake.
    """
    file = place_of(path)
    if not file.exists() or (file.is_file() and file.stat().st_size == 0):
        return 0
    with _opened(file) as stream:
        try:
            with zipfile.ZipFile(stream) as archive:
                return int(_head(archive, os.fstat(stream.fileno()).st_size)["iterations"])
        except Exception as e:
            raise _none(file, _reason(e), "or choose another place") from e


def _opened(file: Path) -> Any:
    """The file open to be read. Nothing but a file is opened: a pipe would wait for its writer."""
    try:
        mode = file.stat().st_mode
        if not stat.S_ISREG(mode):
            raise _none(file, "it is a folder" if stat.S_ISDIR(mode) else "it is no file")
        return open(file, "rb")
    except OSError as e:
        raise type(e)(f"The checkpoint {shown(file)} cannot be read: {e.strerror}.") from e


def _none(file: Path, reason: str, advice: str = "or pass resume=False with another") -> ValueError:
    return ValueError(f"{shown(file)} is no checkpoint of a fit ({reason}). Delete it, {advice}.")


def _reason(e: Exception) -> str:
    if isinstance(e, MemoryError):
        return "there is no memory to read it"
    return str(e).strip().rstrip(".")[:200] or type(e).__name__


def _entry(name: str) -> zipfile.ZipInfo:
    return zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))


def _named(leaves: list[Any]) -> list[tuple[str, Any]]:
    return [(f"leaf{k}", x) for k, x in enumerate(leaves)]


def _kind(x: Any) -> list[Any]:
    """Of a leaf: dtype, shape, and whether its dtype is weak, which decides what it makes of
    others: `[str, list of int, bool]`."""
    return [str(_dtype(x)), list(np.shape(x)), bool(getattr(x, "weak_type", False))]


def _dtype(x: Any) -> Any:
    return x.dtype if hasattr(x, "dtype") else np.asarray(x).dtype


def _bits(x: Any) -> np.ndarray:
    """As NumPy can write it: dtypes that it does not know (bfloat16) by their bits."""
    array = np.asarray(raw(x), order="C")
    return array if array.dtype.kind in "biufc" else array.view(f"u{array.dtype.itemsize}")


def _leaf(stored: np.ndarray, like: Any, kind: list[Any]) -> Any:
    dtype = _dtype(like)
    if jnp.issubdtype(dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(jnp.array(stored), impl=jax.random.key_impl(like))
    if kind[2] and stored.ndim == 0:
        weak = jnp.asarray(stored.item())
        if weak.dtype == dtype:
            return weak
    return jnp.array(stored.view(dtype))


def _head(archive: zipfile.ZipFile, size: int) -> dict[str, Any]:
    """The checked `about.json`."""
    names = archive.namelist()
    if "about.npy" in names:
        raise ValueError("an earlier version wrote it, which did not say what it belongs to")
    head = json.loads(_member(archive, "about.json", size, 0, _MOST))
    if not isinstance(head, dict) or head.get("format") != _FORMAT:
        raise ValueError(f"its format is not {_FORMAT!r}")
    kinds, count = head.get("leaves"), head.get("iterations")
    whole = (
        isinstance(count, int)
        and isinstance(kinds, list)
        and isinstance(head.get("structure"), str)
        and isinstance(head.get("about"), dict)
        and all(
            isinstance(k, list)
            and len(k) == 3
            and isinstance(k[1], list)
            and isinstance(k[2], bool)
            for k in kinds
        )
    )
    if not whole:
        raise ValueError("its description is not that of a fit")
    expected = ["about.json", "losses.npy", *(f"{name}.npy" for name, _ in _named(kinds or []))]
    if names != expected:
        raise ValueError(f"it holds {len(names)} arrays, and should hold {len(expected)}")
    return head


def _member(archive: zipfile.ZipFile, name: str, size: int, least: int, most: int) -> bytes:
    """The bytes of a part of the archive, with their checksum compared."""
    info = archive.getinfo(name)
    if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
        raise ValueError(f"{name} is compressed")
    if not least <= info.file_size <= min(most, size):
        raise ValueError(f"{name} has {info.file_size} bytes, which do not fit")
    return archive.read(info)


def _array(
    archive: zipfile.ZipFile, name: str, dtype: np.dtype, shape: tuple[int, ...], size: int
) -> np.ndarray:
    """An array of this dtype and shape, or ValueError."""
    count = math.prod(shape) * dtype.itemsize
    data = _member(archive, f"{name}.npy", size, count, count + _SLACK)
    wide = 4 if data[6:7] > b"\1" else 2
    end = 8 + wide + int(struct.unpack_from("<I" if wide == 4 else "<H", data, 8)[0])
    header = _HEADER.fullmatch(data[8 + wide : end])
    if data[:6] != b"\x93NUMPY" or header is None or len(data) - end != count:
        raise ValueError(f"{name} is no array")
    found = np.dtype(header[1].decode()), tuple(int(n) for n in header[2].split(b",") if n.strip())
    if found != (dtype, shape):
        raise ValueError(f"{name} is {found[0]} {found[1]}, and should be {dtype} {shape}")
    return np.frombuffer(data, found[0], offset=end).reshape(shape).astype(dtype)
