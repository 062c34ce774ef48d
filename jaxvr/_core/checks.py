"""Checks of what users pass in. Each raises a `ValueError` that says what was found, and where.

Values can be looked at only when they are concrete: under `jit` or `grad` an array is a tracer
and only its shape and dtype are checked.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np

Array = jax.Array

# Light above 1 is legal, since it is brighter than a display's white; above this it is bytes.
BRIGHTEST = 10.0


def is_concrete(*arrays: Any) -> bool:
    """True if no argument is a tracer, so that values can be examined."""
    return not any(isinstance(a, jax.core.Tracer) for a in arrays)


def default_float() -> np.dtype:
    """float64 when the user has turned x64 on, else float32."""
    return np.dtype(jnp.zeros(()).dtype)


def float_dtype(dtype: Any) -> np.dtype:
    """`dtype` as one of the two that jaxvr computes in; float64 only where JAX allows it."""
    d = np.dtype(dtype).newbyteorder("=")
    if d == np.float64 and default_float() == np.float64:
        return d
    return np.dtype(np.float32) if d.kind == "f" else default_float()


def common_float(dtype: Any, *arrays: Any) -> np.dtype:
    """The dtype asked for, else the widest float among the arrays, else JAX's default."""
    if dtype is not None:
        return float_dtype(dtype)
    floats = [
        float_dtype(a.dtype)
        for a in arrays
        if hasattr(a, "dtype") and jnp.issubdtype(a.dtype, jnp.floating)
    ]
    return max(floats, key=lambda d: d.itemsize, default=default_float())


def as_floats(name: str, x: Any, *, ndim: int | None = None, dtype: Any = None) -> Any:
    """`x` as a float array (NumPy stays NumPy, JAX stays JAX), or a ValueError that names it."""
    if not isinstance(x, jax.Array):
        try:
            x = np.asarray(x)
        except Exception as e:
            raise ValueError(f"{name} cannot be read as an array: {e}") from e
        if x.dtype.kind not in "fiub":
            raise ValueError(f"{name} must hold numbers, but has dtype {x.dtype}.")
    elif jnp.issubdtype(x.dtype, jnp.complexfloating):
        raise ValueError(f"{name} must be real, but has dtype {x.dtype}.")
    if ndim is not None and x.ndim != ndim:
        raise ValueError(f"{name} must have {ndim} dimension(s), but has shape {x.shape}.")
    return x.astype(float_dtype(x.dtype) if dtype is None else dtype)


def require_kind(name: str, x: Any, kind: type, hint: str = "") -> None:
    """ValueError unless `x` is an instance of this public class."""
    if not isinstance(x, kind):
        what = f"{name} must be a jaxvr.{kind.__name__}, but is a {type(x).__name__}."
        raise ValueError(f"{what} {hint}".rstrip())


def refuse_bytes(name: str, x: Any, hint: str = "") -> None:
    """ValueError for a picture of integers or booleans: in floats 255 would be 255 times white."""
    dtype = getattr(x, "dtype", None)
    if dtype is None:
        try:
            dtype = np.asarray(x).dtype
        except Exception:
            return  # said by whoever reads it
    if np.dtype(dtype).kind in "iub":
        most = {1: 255, 2: 65535}.get(np.dtype(dtype).itemsize, 255)
        what = (
            f"{name} has dtype {dtype}, but pictures are floats, linear light from 0 to 1. Read "
            f"files with jaxvr.load_image, or divide by {most}."
        )
        raise ValueError(f"{what} {hint}".rstrip())


def as_light(name: str, x: Any) -> Any:
    """Colours as `as_floats` gives them, or a ValueError as `require_light` says. In integers black
    and white are what they are in floats, and what is above 1 is bytes, however dark."""
    light = as_floats(name, x)
    whole = is_concrete(x) and np.asarray(x).dtype.kind in "iu"
    require_light(name, light, most=1 if whole else BRIGHTEST)
    return light


def require_light(name: str, x: Any, most: float = BRIGHTEST) -> None:
    """ValueError for colours with NaN or infinite entries, and for bytes, which `most` tells from
    light (if concrete)."""
    require_finite(name, x)
    if not is_concrete(x):
        return
    found = float(np.max(np.asarray(x), initial=0))
    if found > most:
        raise ValueError(
            f"{name} holds {found:g}, but colours are linear light from 0 to 1. Divide bytes by "
            "255."
        )


def require_finite(name: str, x: Any) -> None:
    """ValueError with the count and the first index of NaN or infinite entries (if concrete)."""
    if not is_concrete(x):
        return
    bad = ~np.isfinite(np.asarray(x))
    if bad.any():
        first = tuple(int(i) for i in np.argwhere(bad)[0])
        where = first[0] if len(first) == 1 else first
        more = ": there is no colour for NaN, as ParaView has one" if name == "values" else ""
        raise ValueError(
            f"{name} has {int(bad.sum())} NaN or infinite entries, the first at index {where}. "
            f"Remove or replace them{more}."
        )


def require_shape(name: str, x: Any, shape: tuple[int | None, ...]) -> None:
    """ValueError unless `x` has this shape (`None` matches any length)."""
    ok = x.ndim == len(shape) and all(
        s is None or s == n for s, n in zip(shape, x.shape, strict=True)
    )
    if not ok:
        want = ", ".join("any" if s is None else str(s) for s in shape)
        want = f"({want},)" if len(shape) == 1 else f"({want})"
        raise ValueError(f"{name} must have shape {want}, but has {x.shape}.")
