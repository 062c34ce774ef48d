"""What a checkpoint belongs to, and what is another than it was.

A dict that JSON can hold. Its entries are settings, which messages show, but for three: "digests"
of data, by name; "programs", digests of functions as JAX traces them; "environment", what the bits
of a result depend on beside the arguments. Between two environments programs are not compared,
since the same functions are traced in other ways there.
"""

from __future__ import annotations

import importlib
import platform
from pathlib import Path
from typing import Any

import jax

from jaxvr._core.checks import default_float
from jaxvr._core.warn import warn
from jaxvr._core.writing import shown

_GROUPS = ("digests", "programs", "environment")
_MOST = 8  # differences that a message names
_PACKAGES = ("jaxvr", "jax", "jaxlib", "numpy", "optax")


class CheckpointWarning(UserWarning):
    """A checkpoint that could not be written, or that is not quite what was asked for."""


def environment(**more: Any) -> dict[str, str]:
    """Versions, machine, and the default dtype."""
    versions = {n: str(getattr(importlib.import_module(n), "__version__", "")) for n in _PACKAGES}
    device = jax.devices()[0]
    there = {"device": f"{device.platform} {device.device_kind}", "machine": platform.machine()}
    return (
        versions | there | {"floats": str(default_float())} | {k: str(v) for k, v in more.items()}
    )


def differences(file: Path, stored: dict[str, Any], now: dict[str, Any], unlike: list[str]) -> None:
    """ValueError that says what differs, `unlike` included; a warning for another environment."""
    was, here = _group(stored, "environment"), _group(now, "environment")
    moved = [f"{k} was {was.get(k, 'none')} and is {v}" for k, v in here.items() if was.get(k) != v]
    others = [key for key in now if key not in _GROUPS and stored.get(key) != now[key]]
    found = [f"{key} was {_brief(stored.get(key))} and is {_brief(now[key])}" for key in others]
    before, after = _group(stored, "digests"), _group(now, "digests")
    names = [name for name in after if name not in others]
    found += [said for name in names if (said := _changed(name, before.get(name), after[name]))]
    found += unlike
    if "verb" in others:  # nothing else can be compared then
        found = [said for said in found if said.startswith("verb ")]
    if not (found or moved):
        before, after = _group(stored, "programs"), _group(now, "programs")
        found = [f"{name} is another" for name in after if before.get(name) != after[name]]
        # The first says most: what comes after it is made of it.
        found = found[:1]
    if found:
        more = f"; and {len(found) - _MOST} more" if len(found) > _MOST else ""
        said = "; ".join(found[:_MOST]) + more
        raise ValueError(
            f"The checkpoint {shown(file)} belongs to another fit: {said}. Pass what it "
            "was made with, another file, or resume=False."
        )
    if moved:
        names = ", ".join(_group(now, "programs"))
        warn(
            f"The checkpoint {shown(file)} was made elsewhere: {'; '.join(moved)}. The fit goes "
            "on, but not to the bit as if it had never stopped, and what cannot be compared is "
            f"taken to be the same: {names}.",
            CheckpointWarning,
        )


def _group(about: dict[str, Any], name: str) -> dict[str, Any]:
    group = about.get(name, {})
    return group if isinstance(group, dict) else {}


def _changed(name: str, was: Any, now: Any) -> str | None:
    """In words, if it is another; of lists which entries are."""
    if was == now:
        return None
    if not (isinstance(was, list) and isinstance(now, list)):
        return f"{name} is another" if not name.endswith("s") else f"{name} are others"
    if len(was) != len(now):
        return f"{name} were {len(was)} and are {len(now)}"
    changed = [k for k, (a, b) in enumerate(zip(was, now, strict=True)) if a != b]
    return f"{len(changed)} of {len(now)} {name} are others, the first is {name}[{changed[0]}]"


def _brief(x: Any, most: int = 120) -> str:
    text = repr(x)
    return text if len(text) <= most else f"{text[:most]}..."
