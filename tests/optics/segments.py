"""Segments to integrate, and what integrators make of them: shared by the tests of integrators."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick

from jaxvr.optics import Segment, TransferFunction

TF = TransferFunction(
    np.array([0.1, 0.3, 0.5, 0.5, 0.8]),
    np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0.2, 0.5, 1.0]]),
    np.array([0.5, 2.0, 1.0, 4.0, 0.3]),
)

CASES = [
    (0.2, 0.25, 1.0),  # inside a slab
    (0.0, 1.0, 2.0),  # through everything, upwards
    (1.0, 0.0, 2.0),  # and downwards
    (0.4, 0.4, 1.0),  # constant
    (0.5, 0.5, 1.0),  # constant at the jump: the upper side
    (0.05, 0.02, 3.0),  # below all control points
    (0.9, 2.0, 3.0),  # above all of them
    (0.3, 0.5, 1.0),  # from a control point up to the jump
    (0.5, 0.3, 1.0),  # from the jump down
    (0.45, 0.55, 5.0),  # across the jump
    (0.3, 0.3 + 1e-7, 1.0),  # hardly any change, at a control point
    (0.1, 0.8, 0.0),  # no length
]


def segment_of(cases, dtype="float64") -> Segment:
    """Segments (R,) from rows of (front, back, length)."""
    return Segment(*(jnp.asarray(x, dtype) for x in np.array(cases).T))


def random_segments(n: int, low=-0.2, high=1.2, length=3.0, seed=0, dtype="float64") -> Segment:
    rng = np.random.default_rng(seed)
    return segment_of(
        np.stack([*rng.uniform(low, high, (2, n)), rng.uniform(0, length, n)], 1), dtype
    )


def integrate(integrator, tf, segment, start=None):
    """Whole segments (R,), piece after piece: rgb (3, R), depth (R,), and whether all was seen."""
    table = integrator.prepare(tf, segment.front.dtype, jnp.max(segment.length))
    cursor = integrator.start(table, segment.front) if start is None else start

    def body(carry, _):
        cursor, rgb, depth, done = carry
        color, tau, new, finished, _ = integrator.step(table, segment, cursor)
        rgb = jnp.where(done[None], rgb, rgb + jnp.exp(-depth)[None] * color)
        depth = jnp.where(done, depth, depth + tau)
        keep = jax.tree.map(lambda a, b: jnp.where(done, b, a), new, cursor)
        return (keep, rgb, depth, done | finished), None

    size = segment.front.shape
    zero = jnp.zeros(size, segment.front.dtype)
    start = (cursor, jnp.zeros((3, *size), zero.dtype), zero, jnp.zeros(size, bool))
    (_, rgb, depth, done), _ = jax.lax.scan(body, start, length=16)
    return rgb, depth, done


def traced_colors_of(integrator, tf, segment):
    """rgb and depth of segments, (4, R). NaN where the segment was not finished."""
    rgb, depth, done = integrate(integrator, tf, segment)
    return jnp.where(done[None], jnp.concatenate([rgb, depth[None]]), jnp.nan)


colors_of = quick.jit(traced_colors_of, static_argnums=0)


def check_slopes(function, args, rtol, seed=0, steps=(1e-5, 5e-6)):
    """That forward and reverse mode agree with each other, and with differences, along one
    direction in all of `args`; compiled once. Both are of a random projection of the result."""
    leaves, structure = jax.tree.flatten(args)
    rng = np.random.default_rng(seed)
    way = [jnp.asarray(rng.normal(size=jnp.shape(x))) for x in leaves]

    @quick.jit
    def both(leaves):
        def projected(leaves):
            out = jnp.concatenate(
                [jnp.ravel(x) for x in jax.tree.leaves(function(*structure.unflatten(leaves)))]
            )
            return out @ jnp.asarray(np.random.default_rng(seed + 1).normal(size=out.shape))

        value, slope = jax.jvp(projected, (leaves,), (way,))
        bars = jax.grad(projected)(leaves)
        return value, slope, sum(jnp.sum(b * w) for b, w in zip(bars, way, strict=True))

    def at(h):
        return float(both([x + h * w for x, w in zip(leaves, way, strict=True)])[0])

    _, forward, reverse = (float(x) for x in both(leaves))
    coarse, fine = ((at(h) - at(-h)) / (2 * h) for h in steps)
    assert reverse == pytest.approx(forward, rel=1e-9)
    assert forward == pytest.approx((4 * fine - coarse) / 3, rel=rtol)
