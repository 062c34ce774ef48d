"""Full pre-integration: a table over both end scalars and the length of a segment.

Roettger, Kraus and Ertl 2000; Engel, Kraus and Ertl 2001; here as in Callahan et al. 2005 (linear
lengths) and in Kraus, Qiao and Ebert 2004 (logarithmic lengths). The table's length runs from 0 to
the longest segment there can be, its scalars from the first control point to the last; what lies
outside of them has constant colour and extinction, and its part of a segment is integrated exactly.

"Hardware-accelerated volume and isosurface rendering based on cell-projection" (Roettger et al.),
doi:10.1145/383507.383515 (Engel et al.), "Hardware-assisted visibility sorting for unstructured
volume rendering" (Callahan et al.), doi:10.1109/VISUAL.2004.85 (Kraus et al.)
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core.pytree import noun, pytree, static
from jaxvr._core.stage import stage
from jaxvr.numerics.moments import emission_weights, opacity
from jaxvr.optics.integrator import slab_of
from jaxvr.optics.partition import Nodes, Segment, nodes_of
from jaxvr.optics.preintegration_table import direct, doubling, halves, one_by_one
from jaxvr.optics.whole import AbstractWholeIntegrator, Table

Array = jax.Array

SCHEDULES = {"halves": halves, "one by one": one_by_one}
# A logarithmic table reaches down over about this many octaves.
_OCTAVES = 16


@pytree
class Frame:
    """low, high (): first and last control point. below, above (4,): extinction and colour outside.
    longest (): length of the last slice."""

    low: Array
    high: Array
    below: Array
    above: Array
    longest: Array


@noun
class PreIntegration(AbstractWholeIntegrator):
    """One trilinear lookup a segment, however many control points it crosses.

    size: nodes over the front scalar and over the back scalar, and slices over length.
    scale: "linear" slices, evenly spaced, or "log", where each is 2^(1/p) times as long as the one
      before it and the first of them follows 0. With p = 1 that is equation 1 of Kraus et al. 2004;
      here p = ceil((n_l - 2) / 16), so that larger tables get finer, not ever shorter.
    incremental: whether slices are composed of earlier ones, or all integrated exactly (see
      `jaxvr.optics.preintegration_table`); both are differentiable.
    schedule: how a linear table is composed, "halves" or, as in the papers, "one by one", which is
      several times less accurate in the mean.
    bits: None, or 8 or 16 to round the finished table to so many bits a channel, colours clipped
      to [0, 1], as graphics hardware of the time did. Derivatives ignore the rounding.

    The error is that of the table. Control points and peaks between two nodes are blurred;
    on a linear scale, segments much shorter than the first slice lose colour (Kraus et al., Figure
    10). Opacity saturates at 1 minus one rounding. Memory: 16 bytes an entry in float32, so 34 MB
    for the default size, and several times that for a gradient with respect to the transfer
    function, which goes through the table and its making. The derivative is that of the
    interpolated table; where a segment leaves the control points it is cut at fixed parameters.

    `slab` takes the two ends as nodes of a table whose longest length is the longest one given.

    Raises:
      ValueError: for a size below (2, 2, 3) or above 2^29 entries, another scale or schedule, or
        other bits.
    """

    size: tuple[int, int, int] = static(default=(128, 128, 128))
    scale: str = static(default="linear")
    incremental: bool = static(default=True)
    schedule: str = static(default="halves")
    bits: int | None = static(default=None)

    def __post_init__(self):
        object.__setattr__(self, "size", tuple(self.size))
        whole = len(self.size) == 3 and all(isinstance(n, int) for n in self.size)
        if not whole or any(n < least for n, least in zip(self.size, (2, 2, 3))):
            raise ValueError(f"size must be three integers from (2, 2, 3) on, but is {self.size}.")
        if 4 * math.prod(self.size) >= 2**31:
            raise ValueError(f"A table of size {self.size} is too large for 32-bit indices.")
        if self.scale not in ("linear", "log"):
            raise ValueError(f"scale must be 'linear' or 'log', but is {self.scale!r}.")
        if self.schedule not in SCHEDULES:
            raise ValueError(
                f"schedule must be one of {list(SCHEDULES)}, but is {self.schedule!r}."
            )
        if self.bits not in (None, 8, 16):
            raise ValueError(f"bits must be None, 8 or 16, but is {self.bits!r}.")

    def slab(self, extinction_front, extinction_back, color_front, color_back, length):
        length = jnp.asarray(length)
        length = length.astype(jnp.result_type(length, extinction_front, jnp.float32))
        longest = lax.stop_gradient(jnp.max(length, initial=0))
        longest = jnp.where(longest > 0, longest, 1)
        k, way = self._slice(length, longest)
        ends = (extinction_front, extinction_back, color_front, color_back)
        entries = []
        for slice_ in (k, k + 1):
            rgb, alpha = slab_of(emission_weights, *ends, self._length(slice_, longest))
            entry = jnp.concatenate([rgb, alpha[..., None]], -1)
            entries.append(entry if self.bits is None else _rounded(entry, self.bits))
        way = jnp.broadcast_to(way, entries[0].shape[:-1])[..., None]
        entry = entries[0] + way * (entries[1] - entries[0])
        return entry[..., :3], entry[..., 3]

    def prepare(self, transfer, dtype, longest):
        nodes = nodes_of(transfer, dtype)
        low, high = nodes.position[0], nodes.position[-1]
        if longest is None:
            raise ValueError(
                "PreIntegration has a table up to the longest segment there can be, and this "
                "tracer gives no bound: write its longest(scene), or take Analytic()."
            )
        longest = jnp.where(longest > 0, longest, 1).astype(dtype)
        slices = self._build(nodes, longest)
        if self.bits is not None:
            slices = _rounded(slices, self.bits)
        # Length varies fastest: the two entries that a lookup blends first are neighbours.
        rows = slices.transpose(2, 3, 0, 1).reshape(-1, 4)
        return Table(rows, Frame(low, high, nodes.optical[:, 0], nodes.optical[:, -1], longest))

    def _build(self, nodes: Nodes, longest: Array) -> Array:
        """Slices (n_l, 4, n_f, n_b)."""
        n_f, n_b, n_l = self.size
        low, high = nodes.position[0], nodes.position[-1]

        def over(n):
            t = jnp.arange(n).astype(longest.dtype) / (n - 1)
            return low * (1 - t) + high * t  # ends at `high` exactly

        scalars = over(n_f), over(n_b)
        lengths = self._length(jnp.arange(1, n_l), longest)
        if not self.incremental:
            slices = direct(nodes, scalars, lengths)
        elif self.scale == "linear":
            slices = SCHEDULES[self.schedule](direct(nodes, scalars, lengths[:1])[0], n_l - 1)
        else:
            base = direct(nodes, scalars, lengths[: min(self._per_octave, n_l - 1)])
            slices = doubling(base, n_l - 1)
        return jnp.concatenate([jnp.zeros_like(slices[:1]), slices])

    @property
    def _per_octave(self) -> int:
        return -(-(self.size[2] - 2) // _OCTAVES)

    def _length(self, k: Array, longest: Array) -> Array:
        """Length of slice k."""
        last = self.size[2] - 1
        if self.scale == "linear":
            return longest * (k.astype(longest.dtype) / last)
        shrunk = jnp.exp2((k - last).astype(longest.dtype) / self._per_octave)
        return jnp.where(k > 0, longest * shrunk, 0)

    def _slice(self, length: Array, longest: Array) -> tuple[Array, Array]:
        """The slice below a length (R,), and the way to the next one, differentiable."""
        last = self.size[2] - 1
        if self.scale == "linear":
            at = length * (last / longest)
            left = jnp.clip(lax.stop_gradient(at).astype(jnp.int32), 0, last - 1)
            return left, at - left.astype(at.dtype)
        held = lax.stop_gradient(length) / longest
        at = last + self._per_octave * jnp.log2(jnp.maximum(held, jnp.finfo(held.dtype).tiny))
        left = jnp.clip(at.astype(jnp.int32), 0, last - 1)
        # Slices are logarithmic, the way between two of them is linear in length: colours of thin
        # segments are. (Equation 1 is linear in the logarithm, an error of 6 % between octaves.)
        start = self._length(left, longest)
        return left, (length - start) / (self._length(left + 1, longest) - start)

    def address(self, table, segment):
        frame = table.frame
        n_f, n_b, n_l = self.size
        _, (front, back, length), _ = _parts(frame, segment)
        (i, _), (j, _) = _node(front, frame, n_f), _node(back, frame, n_b)
        k, _ = self._slice(length, frame.longest)
        first = (i * n_b + j) * n_l + k
        steps = [0, 1, n_l, n_l + 1]
        steps += [n_b * n_l + s for s in steps]
        return jnp.stack([first + s for s in steps])

    def blend(self, frame, rows, segment):
        # Stages, or everything up to here is computed again for each of the four channels.
        wanted = jnp.any(segment.length >= 0)
        way, before, after = stage(wanted, self._ways, frame, segment)
        inside = stage(wanted, _trilinear, rows, way)
        most = 1 - jnp.finfo(inside.dtype).epsneg
        alpha = jnp.where(inside[3] < most, inside[3], most)
        # In front of the table's part, and behind it.
        (color, depth), (far_color, far_depth) = before, after
        rgb = inside[:3] + ((1 - alpha) * opacity(far_depth))[None] * far_color
        rgb = opacity(depth)[None] * color + jnp.exp(-depth)[None] * rgb
        return rgb, depth - jnp.log1p(-alpha) + far_depth

    def _ways(self, frame, segment):
        n_f, n_b, _ = self.size
        before, (front, back, length), after = _parts(frame, segment)
        (_, u), (_, v) = _node(front, frame, n_f), _node(back, frame, n_b)
        _, w = self._slice(length, frame.longest)
        return (u, v, w), before, after


def _trilinear(rows: Array, way: tuple[Array, Array, Array]) -> Array:
    for t in reversed(way):
        rows = rows[:, 0::2] + t[None, None] * (rows[:, 1::2] - rows[:, 0::2])
    return rows[:, 0]


def _rounded(table: Array, bits: int) -> Array:
    top = 2**bits - 1
    return table + lax.stop_gradient(jnp.round(jnp.clip(table, 0, 1) * top) / top - table)


def _node(scalar: Array, frame: Frame, size: int) -> tuple[Array, Array]:
    """The table's node below a scalar (R,), and the way to the next one."""
    width = frame.high - frame.low
    at = (scalar - frame.low) * ((size - 1) / jnp.where(width > 0, width, 1))
    left = jnp.clip(lax.stop_gradient(at).astype(jnp.int32), 0, size - 2)
    return left, at - left.astype(at.dtype)


def _parts(frame: Frame, segment: Segment):
    """What lies outside the control points on either side, as (colour (3, R), optical depth (R,)),
    and between them the segment that is left.

    Where a segment is cut is held fixed in derivatives, as in `jaxvr.optics.partition`.
    """
    low, high, front, back = (
        lax.stop_gradient(x) for x in (frame.low, frame.high, segment.front, segment.back)
    )
    change = back - front
    flat = change == 0
    per_change = 1 / jnp.where(flat, 1, change)
    cuts = [jnp.clip((x - front) * per_change, 0, 1) for x in (low, high)]
    outside = flat & ((front < low) | (front >= high))
    start = jnp.where(flat, outside.astype(front.dtype), jnp.minimum(*cuts))
    end = jnp.where(flat, 1, jnp.maximum(*cuts))

    def constant(scalar, share):
        optical = jnp.where((scalar < low)[None], frame.below[:, None], frame.above[:, None])
        return optical[1:], optical[0] * (segment.length * share)

    move = segment.back - segment.front
    middle = Segment(
        segment.front + start * move, segment.front + end * move, segment.length * (end - start)
    )
    return constant(front, start), middle, constant(back, 1 - end)
