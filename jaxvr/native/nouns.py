"""Which nouns are written in C, and how their numbers and states are packed: the one list of them.

To cover another noun: write it in `src/`, and say here what it is to them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxvr.composite.maximum_intensity import MaximumIntensity, MaximumState
from jaxvr.composite.over import Over, OverState
from jaxvr.composite.xray import XRay, XRayState
from jaxvr.optics.analytic import Analytic
from jaxvr.optics.unshaded import Unshaded
from jaxvr.trace.raycast import RayCast
from jaxvr.trace.recorded import Recorded

Array = jax.Array


class Calls(NamedTuple):
    """A tracer: names of the functions that composite what it finds, and that differentiate it;
    reverse: whether an object of it goes from behind."""

    forward: str
    backward: str
    reverse: Callable[[Any], bool]


class Packing(NamedTuple):
    """A compositor.

    kind: from one, its `Compositor` of src/whole.h. enough: from one, the optical depth at which
    rays end. has_place: whether it keeps integers (2, N).
    state: from sums (8, N) and the integers. finals: from one, the state of rays (N,) and its
    cotangent, to sums (8, N), cotangents (4, N) and where the largest scalars are, (N,) or (0,).
    is_light: whether the sums hold colours.
    """

    kind: Callable[[Any], int]
    enough: Callable[[Any], Any]
    has_place: bool
    is_light: bool
    state: Callable[[Array, Array], Any]
    finals: Callable[[Any, Any, Any], tuple[Array, Array, Array]]


def _never(_: Any) -> float:
    return math.inf


def _nowhere() -> Array:
    return jnp.zeros(0, jnp.int32)


def _over_state(sums: Array, _: Array) -> OverState:
    return OverState((sums[0], sums[4]), (sums[1:4], sums[5:8]))


def _over_finals(_: Over, final: OverState, cotangent: Any) -> tuple[Array, Array, Array]:
    sums = [final.depth[0], *final.rgb[0], final.depth[1], *final.rgb[1]]
    bars = [*cotangent.rgb[0], cotangent.depth[0]]
    return jnp.stack(sums), jnp.stack(bars), _nowhere()


def _largest_state(sums: Array, integers: Array) -> MaximumState:
    return MaximumState(sums[0], integers[0], integers[1])


def _largest_finals(
    _: MaximumIntensity, final: MaximumState, cotangent: Any
) -> tuple[Array, Array, Array]:
    zero = jnp.zeros_like(final.largest)
    bars = [cotangent.largest, zero, zero, zero]
    return jnp.stack([final.largest, *[zero] * 7]), jnp.stack(bars), final.where


def _xray_state(sums: Array, _: Array) -> XRayState:
    return XRayState((sums[0], sums[4]), (sums[1], sums[5]))


def _xray_finals(compositor: XRay, final: XRayState, cotangent: Any) -> tuple[Array, Array, Array]:
    (integral, lost), (length, missed) = final
    zero = jnp.zeros_like(integral)
    sums = [integral, length, zero, zero, lost, missed, zero, zero]
    by_integral, by_length = cotangent.integral[0], cotangent.length[0]
    bars = [by_integral, by_length, zero, zero]
    if compositor.shades:  # the length has no derivative there, see `XRay.finish`
        bars = [zero, zero, zero, by_integral]
    return jnp.stack(sums), jnp.stack(bars), _nowhere()


TRACERS: dict[type, Calls] = {
    RayCast: Calls("render", "render_pull", lambda _: False),
    Recorded: Calls("shade", "shade_pull", lambda tracer: tracer.reverse),
}
INTEGRATORS: tuple[type, ...] = (Analytic, Unshaded)
COMPOSITORS: dict[type, Packing] = {
    Over: Packing(lambda _: 0, lambda c: c.enough, False, True, _over_state, _over_finals),
    XRay: Packing(lambda c: 1 if c.shades else 2, _never, False, False, _xray_state, _xray_finals),
    MaximumIntensity: Packing(lambda _: 3, _never, True, False, _largest_state, _largest_finals),
}


def unwritten(tracer: Any, integrator: Any, compositor: Any) -> str | None:
    """None where these are written, else why not. Nouns that are None are not asked for."""
    known = (*TRACERS, *INTEGRATORS, *COMPOSITORS)
    nouns = [noun for noun in (tracer, integrator, compositor) if noun is not None]
    others = [noun for noun in nouns if type(noun) not in known]
    backwards = compositor is not None and compositor.backwards
    if backwards or (type(tracer) in TRACERS and TRACERS[type(tracer)].reverse(tracer)):
        return "Its loops go front to back."
    return f"There are none for {type(others[0]).__name__}." if others else None
