"""What an integrator is: it turns segments into colour and optical depth, piece by piece.

An integrator is a frozen dataclass: its numbers are leaves, and the rest is static
(`_core.pytree.noun`; `jax.tree_util.register_dataclass` for a user's own, and a class that is not
registered is static as a whole). `prepare` and `step` may use the numbers, with derivatives.
Tables that depend on the transfer function are made by `prepare` and travel as a pytree. To add an
integrator of slabs, derive from `AbstractSlabIntegrator` and write `weights`; one that
treats whole segments at once (a pre-integrated table) derives from `AbstractIntegrator`.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from jaxvr._core.pytree import noun
from jaxvr._core.stage import stage
from jaxvr.numerics.moments import opacity
from jaxvr.optics.partition import (
    Cursor,
    Ends,
    Nodes,
    Segment,
    cut,
    ends,
    gather,
    is_empty,
    locate,
    look_up,
    merge_transparent,
    nodes_of,
    with_texture,
)
from jaxvr.optics.transfer import TransferFunction

Array = jax.Array
Weights = Callable[[Array, Array], tuple[Array, Array]]


class AbstractIntegrator(abc.ABC):
    """Colour and optical depth of segments under a transfer function."""

    @abc.abstractmethod
    def slab(
        self,
        extinction_front: Any,
        extinction_back: Any,
        color_front: Any,
        color_back: Any,
        length: Any,
    ) -> tuple[Array, Array]:
        """rgb (..., 3), premultiplied, and alpha (...) of slabs with linear extinction and colour.

        Args:
          extinction_front, extinction_back (...): per unit of length, >= 0.
          color_front, color_back (..., 3): linear RGB. length (...): world length, >= 0.
        """

    @abc.abstractmethod
    def reversed(self) -> AbstractIntegrator:
        """The same integrals for segments that come from behind: light leaves by their `back`."""

    @abc.abstractmethod
    def prepare(self, transfer: TransferFunction, dtype: Any, longest: Array | None) -> Any:
        """The table that `step` looks up, differentiable with respect to `transfer`.

        longest (): a bound on the length of a segment, a constant to derivatives; None where the
            tracer gives none.
        """

    @abc.abstractmethod
    def shorten(self, table: Any, image_only: bool) -> Any:
        """A table with fewer pieces to walk, where what is transparent can be passed at once.

        The image is that of `table`, and so are its derivatives with respect to segments unless
        `image_only`. Not for derivatives with respect to the table.
        """

    @abc.abstractmethod
    def start(self, table: Any, scalar: Array) -> Cursor:
        """A cursor at the start of segments whose front scalar is `scalar` (R,)."""

    @abc.abstractmethod
    def step(
        self, table: Any, segment: Segment, cursor: Cursor
    ) -> tuple[Array, Array, Cursor, Array, Any]:
        """Next piece: rgb (3, R), optical depth (R,), cursor behind it, segment finished (R,), and
        what `pull_back` wants to know of it."""

    @abc.abstractmethod
    def gradient_start(self, table: Any) -> Any:
        """Zeros to accumulate a gradient of the table in."""

    @abc.abstractmethod
    def pull_back(
        self,
        table: Any,
        segment: Segment,
        piece: Any,
        cotangent: tuple[Array, Array],
        gradient: Any,
    ) -> tuple[Segment, Any]:
        """Cotangents of the segment, and `gradient` with the table's share added.

        Args:
          piece: from `step`.
          cotangent: of the piece's rgb (3, R) and optical depth (R,).
          gradient: as from `gradient_start`, or None if the table's gradient is not wanted.
        """

    @abc.abstractmethod
    def gradient_finish(self, table: Any, gradient: Any) -> Any:
        """The accumulated gradient, in the form of `table`."""


class AbstractSlabIntegrator(AbstractIntegrator):
    """Cuts segments at control points, so that only the integral of one slab is left to write.

    In a slab extinction and colour are linear, and light is linear in colour: the colour is
    C_front w_front + C_back w_back, with weights that depend on a and b only, the extinctions at
    the two ends times the length. The optical depth is (a + b) / 2.
    """

    @abc.abstractmethod
    def weights(self, a: Array, b: Array) -> tuple[Array, Array]:
        """(w, w_back) of slabs, differentiable; w = w_front + w_back is what a constant colour
        gets, which is 1 - exp(-(a + b) / 2) for the exact integral.

        Args:
          a, b (R,): extinction at the front and the back times length, >= 0.
        """

    def slab(self, extinction_front, extinction_back, color_front, color_back, length):
        operands = (extinction_front, extinction_back, color_front, color_back, length)
        return slab_of(self.weights, *operands)

    def reversed(self):
        return SlabsFromBehind(self)

    def prepare(self, transfer, dtype, longest):
        return nodes_of(transfer, dtype)

    def shorten(self, table, image_only):
        nodes = dataclasses.replace(merge_transparent(table), image_only=image_only)
        return nodes if table.texture is None else with_texture(nodes, table.texture.shape[0])

    def start(self, table, scalar):
        scalar = jax.lax.stop_gradient(scalar)
        return Cursor(scalar, locate(table.position, scalar))

    def step(self, table, segment, cursor):
        # Segments of no length are not seen, but they have derivatives, whatever the other rays of
        # the batch are in.
        wanted = jnp.any(segment.length > 0 if table.image_only else segment.length >= 0)
        if table.texture is not None:
            cursor = stage(wanted, look_up, table, segment, cursor)
        piece, cursor, finished = stage(jnp.any(segment.length >= 0), cut, table, segment, cursor)
        if table.image_only:
            wanted = jnp.any((segment.length > 0) & ~is_empty(table, piece))
        slabs = stage(wanted, gather, table, piece)
        rgb, depth = stage(
            wanted, lambda *x: shade_slab(self.weights, ends(*x)), piece, segment, slabs
        )
        return rgb, depth, cursor, finished, (piece, slabs)

    def gradient_start(self, table):
        # Row left + right holds both control points of a slab, (position, optical) twice: even
        # rows are the outermost slabs, whose control points coincide, row 2 k + 1 is slab k, k + 1.
        return jnp.zeros((2 * table.position.shape[0], 10), table.position.dtype)

    def pull_back(self, table, segment, piece, cotangent, gradient):
        def pull(segment, piece, slabs, cotangent):
            _, back = jax.vjp(
                lambda s, t: shade_slab(self.weights, ends(piece, s, t)), segment, slabs
            )
            return back(cotangent)

        piece, slabs = piece
        segment_bar, slabs_bar = stage(
            jnp.any(segment.length >= 0), pull, segment, piece, slabs, cotangent
        )
        if gradient is not None:
            rows = jnp.concatenate([slabs_bar.position[:, None], slabs_bar.optical], 1)
            gradient = gradient.at[piece.left + piece.right].add(rows.reshape(10, -1).T)
        return segment_bar, gradient

    def gradient_finish(self, table, gradient):
        count = table.position.shape[0]
        rows = jnp.arange(2 * count)
        left, right = rows // 2, jnp.minimum((rows + 1) // 2, count - 1)
        nodes = jnp.zeros((count, 5), gradient.dtype)
        nodes = nodes.at[left].add(gradient[:, :5]).at[right].add(gradient[:, 5:])
        return Nodes(nodes[:, 0], nodes[:, 1:].T)


@noun
class SlabsFromBehind(AbstractSlabIntegrator):
    """The slabs of `other`, with light that leaves by the back.

    With its ends exchanged a slab has the weights w_front and w_back of `weights(b, a)`, so that

        rgb = C_back w_front + C_front w_back = C_front w + (C_back - C_front) (w - w_back)

    Pieces are cut as they come, so this is all that there is to turn.
    """

    other: AbstractSlabIntegrator

    def prepare(self, transfer, dtype, longest):
        return self.other.prepare(transfer, dtype, longest)

    def weights(self, a, b):
        w, w_back = self.other.weights(b, a)
        return w, w - w_back


def shade_slab(weights: Weights, piece: Ends) -> tuple[Array, Array]:
    """rgb (3, R), premultiplied, and optical depth (R,) of slabs; `weights` as in
    `AbstractSlabIntegrator`."""
    a, b = piece.front[0] * piece.length, piece.back[0] * piece.length
    # In kernels of their own, or they are computed again for each channel. (Not skipped at length
    # 0, where the derivative with respect to the length is not 0.)
    w, w_back = stage(jnp.any(~(piece.length < 0)), weights, a, b)
    color, change = piece.front[1:], piece.back[1:] - piece.front[1:]
    return color * w[None] + change * w_back[None], 0.5 * (a + b)


def slab_of(
    weights: Weights,
    extinction_front: Any,
    extinction_back: Any,
    color_front: Any,
    color_back: Any,
    length: Any,
) -> tuple[Array, Array]:
    """`AbstractIntegrator.slab` from weights."""
    tau_f, tau_b = jnp.asarray(extinction_front), jnp.asarray(extinction_back)
    c_f, c_b, size = jnp.asarray(color_front), jnp.asarray(color_back), jnp.asarray(length)
    shape = jnp.broadcast_shapes(
        tau_f.shape, tau_b.shape, c_f.shape[:-1], c_b.shape[:-1], size.shape
    )
    dtype = jnp.result_type(tau_f, tau_b, c_f, c_b, size, jnp.float32)

    def column(tau, color):
        tau = jnp.broadcast_to(tau, shape).reshape(1, -1)
        color = jnp.broadcast_to(color, (*shape, 3)).reshape(-1, 3).T
        return jnp.concatenate([tau, color]).astype(dtype)

    size = jnp.broadcast_to(size, shape).reshape(-1).astype(dtype)
    rgb, depth = shade_slab(weights, Ends(column(tau_f, c_f), column(tau_b, c_b), size))
    return rgb.T.reshape(*shape, 3), opacity(depth).reshape(shape)
