"""How far from sorted a stream of fragments is, and how many entries a k-buffer needs for it.

Callahan et al. 2005, section 3.1: ESS(S) = (a_1, ..., a_n) has the position a_i of s_i among the
sorted elements of S, and a tuple (b_1, ..., b_n) of positions is k-nearly sorted if
max |a_i - b_i| = k. For fragments in the order of their arrival b_i = i. That measure is symmetric,
but a buffer suffers from one side of it only: a fragment that comes early waits in the buffer and
takes one entry, however far it has to go back; one that comes late must still find its place.
Lateness is what section 5 of the paper records, as the depth of an insertion into a sorted list:

    m_i = #{j < i : s_j > s_i}.

**A k-buffer** holds k entries besides the fragment that arrives. At first it only fills; when one
arrives at a full buffer, the closest two of the k + 1 are composited and the closest is dropped; at
the end it is emptied in the same way. *It composites every pair of neighbours, and nothing else, if
and only if*

    k >= 1,    k >= m_i + 1 for all i but the closest fragment,    k >= m_i for the closest.

Proof. Let e_q be the arrival (1, ..., n) of the fragment of rank q. Arrival k + r makes pair r,
for r = 1, ..., n - k. If those before it were right, it is right exactly if ranks r and r + 1 are
there, e_r <= k + r and e_{r+1} <= k + r. So rank q has to be there for pair q - 1, and rank 1,
which is nobody's successor, for pair 1:

    e_q - q <= k - 1 for q >= 2,    e_1 - 1 <= k,                                            (*)

and this holds by itself for the ranks that only the emptying treats, as e_q <= n. Let now m(q) be
the m of rank q. At most q - 1 of the fragments before it are closer, so m(q) >= e_q - q; in
particular m(1) = e_1 - 1. Conversely let r be the rank <= q that arrives last. By then all q have
come, and the m(q) farther ones too: e_r >= q + m(q). If r >= 2, (*) gives m(q) <= e_r - r <= k - 1;
if r = 1 < q, it gives m(q) <= e_1 - q <= k + 1 - q <= k - 1. So (*) and the claim are the same. QED

So max m + 1 is enough, and it is one too many exactly where only the closest fragment is that late:
of two fragments the second may be the closer one, m = (0, 1), and one entry will do. Nothing of the
kind happens at the end of the stream.

The paper says that sorting takes k entries for a k-nearly sorted stream and compositing k + 1,
which agrees: max m <= max |a_i - i|. Its Table 1 explains k as "the number of positions any
fragment had to move ... minus one for compositing". Taken literally, max m - 1, that is two less
than is needed. It is right the other way round: of k entries one is for compositing, so positions
may be up to k - 1; and k = 2 and 6, where the table counts pixels, are what the hardware held
besides the fragment that arrives (section 4).

Fragments of equal depth are sorted as they arrive; all of the above holds for them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def exactly_sorted(values: Any) -> Any:
    """ESS(S): the positions (..., N), from 1, of values (..., N) in ascending order."""
    xp = jnp if isinstance(values, jax.Array) else np
    order = xp.argsort(xp.asarray(values), axis=-1, stable=True)
    return xp.argsort(order, axis=-1) + 1


def displacement(values: Any, positions: Any = None) -> Any:
    """The k (...) for which positions (..., N) are a k-nearly sorted sequence of values (..., N):
    how far any of them is from the exact one. `None`: the values as they stand, 1 to N."""
    xp = jnp if isinstance(values, jax.Array) else np
    right = exactly_sorted(values)
    if positions is None:
        positions = xp.broadcast_to(xp.arange(1, right.shape[-1] + 1), right.shape)
    return xp.max(xp.abs(right - xp.asarray(positions)), axis=-1, initial=0)


def is_k_nearly_sorted(values: Any, k: int, positions: Any = None) -> Any:
    """Whether (...) none of the values (..., N) is more than k positions out of order, `positions`
    as for `displacement`. In the paper k is the largest displacement itself; here any k above it
    serves too."""
    return displacement(values, positions) <= k


def moved(depths: Any) -> Any:
    """How far (..., N) each fragment moves forward when it is inserted into a sorted list: how many
    of those before it are strictly farther. depths (..., N): in the order of arrival; infinite for
    no fragment. Takes memory for N numbers for each of them, unless it is compiled."""
    xp = jnp if isinstance(depths, jax.Array) else np
    depths = xp.asarray(depths)
    n = depths.shape[-1]
    earlier = xp.arange(n)[:, None] > xp.arange(n)[None, :]
    earlier = earlier.reshape((1,) * (depths.ndim - 1) + (n, n))
    mine, other = depths[..., :, None], depths[..., None, :]
    return xp.sum(earlier & (other > mine) & xp.isfinite(other), axis=-1)


def entries_needed(depths: Any) -> Any:
    """The fewest entries (...), at least 1, of a k-buffer that composites all neighbours of depths
    (..., N) right; see the module. Infinite depths stand for no fragment."""
    xp = jnp if isinstance(depths, jax.Array) else np
    m = moved(depths)
    n = m.shape[-1]
    if n == 0:
        return xp.ones(m.shape[:-1], m.dtype)
    number = xp.arange(n).reshape((1,) * (m.ndim - 1) + (n,))
    closest = number == xp.argmin(xp.asarray(depths), axis=-1, keepdims=True)
    return xp.max(xp.where(closest, m, m + 1), axis=-1, initial=1)


def kbuffer_sort(depths: Sequence[float], k: int) -> list[tuple[float, float]]:
    """The pairs that a k-buffer composites, in order, for depths as they arrive. The definition,
    for reference; slow."""
    if k < 1:
        raise ValueError(f"A k-buffer needs at least one entry, but k is {k}.")
    held: list[float] = []
    pairs = []
    for depth in depths:
        held = sorted([*held, depth])
        if len(held) > k:
            pairs.append((held[0], held[1]))
            held = held[1:]
    return pairs + list(zip(held[:-1], held[1:], strict=True))
