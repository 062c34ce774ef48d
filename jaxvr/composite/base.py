"""What a compositor is: it folds the pieces along a ray into a pixel.

Of a ray's pieces p_1, p_2, ... a compositor makes states by `add`, and RGBA of the last by
`finish`. It never sees the volume or the ray, so that any of them works with any tracer and any
integrator. To add one, write a frozen dataclass that derives from `AbstractCompositor`, or from
`AbstractSum`, in a file of its own; `composite.xray` is the shortest. Its numbers are leaves,
arrays of the volume's dtype in its methods, and the rest is static (`_core.pytree.noun`;
`jax.tree_util.register_dataclass` for a user's own, and a class that is not registered is static as
a whole).

Gradients: `finish` is differentiated by JAX. So is `add` in forward mode and by the recording
adjoint; the replaying one, which stores nothing along the ray, asks `pull_back` for the cotangents
of each piece, from the states on both sides of it and the last one. `add` and `finish` may use
numbers of the compositor's own, with derivatives; where `init` does, the replaying adjoint refuses
a gradient by them in words.
"""

from __future__ import annotations

import abc
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxvr.optics.integrator import AbstractIntegrator

Array = jax.Array


class Piece(NamedTuple):
    """A part of a segment, of each of R rays.

    rgb (3, R): premultiplied colour. optical_depth (R,). Both are 0 of rays without a segment.
    segment: that which it is a part of. Each is None for a compositor that does not need it.
    last (R,) bool: the ray has a segment, and this is its last piece: what sees segments as a whole
    looks at them then, once for each.

    As a cotangent, from `AbstractCompositor.pull_back`: None for what a compositor does not need,
    and for `last`.
    """

    rgb: Any
    optical_depth: Any
    segment: Any
    last: Any

    def only(self, needs: frozenset[str]) -> Piece:
        """What a compositor needs of it: to look at anything else is an error then, where it would
        be differentiated wrongly, or be 0, without a word."""
        return Piece(
            self.rgb if "rgb" in needs else None,
            self.optical_depth if "optical_depth" in needs else None,
            self.segment if "scalar" in needs else None,
            self.last,
        )


class Scale(NamedTuple):
    """Of the numbers that pieces have: lengths are the world's times `length` (), scalars the
    world's less `offset` (), or less nothing if that is None, times `scalar` (). The two are powers
    of two, see `jaxvr.units`."""

    scalar: Array
    length: Array
    offset: Array | None


class AbstractCompositor(abc.ABC):
    """States are pytrees with arrays (..., R) over R rays."""

    @property
    def backwards(self) -> bool:
        """Whether pieces are to be added farthest first."""
        return False

    @property
    @abc.abstractmethod
    def needs(self) -> frozenset[str]:
        """What of a piece it sees: "rgb", "optical_depth", "scalar" (the ends and the length of its
        segment); and "transfer" where `finish` sees the transfer function."""

    @property
    def shades(self) -> bool:
        """Whether it sees what an integrator makes of segments."""
        return bool(self.needs & {"rgb", "optical_depth"})

    @property
    def reads_transfer(self) -> bool:
        """Whether pictures depend on a transfer function."""
        return self.shades or "transfer" in self.needs

    @abc.abstractmethod
    def default_integrator(self) -> AbstractIntegrator:
        """The one that serves where the user names none."""

    @abc.abstractmethod
    def init(self, rays: int, dtype: Any) -> Any:
        """The state of R `rays` before their first piece, with floats of this dtype."""

    @abc.abstractmethod
    def add(self, state: Any, piece: Piece) -> Any:
        """The state with one more piece of each ray."""

    def done(self, state: Any) -> Array | None:
        """Rays (R,) that need none of the pieces to come; None if there never are any. They stop at
        the end of their segment."""
        return None

    @abc.abstractmethod
    def finish(self, state: Any, transfer: Any, scale: Any) -> Array:
        """Premultiplied RGBA (4, R); differentiable in all that is a float.

        transfer: a `TransferFunction` with positions in the scalars of the pieces; None unless
        "transfer" is needed. scale: a `Scale`, or None for what does not need the scalar.
        """

    @abc.abstractmethod
    def merge(self, front: Any, back: Any) -> Any:
        """The state of the pieces of `front` with those of `back` behind them: associative, and
        equal to that of all pieces in turn to rounding."""

    @abc.abstractmethod
    def pull_back(
        self, piece: Piece, before: Any, after: Any, final: Any, cotangent: Any
    ) -> tuple[Piece, Any]:
        """Cotangents of a piece, and of the compositor's own numbers by what `add` does with it:
        a compositor with those in place of numbers, summed over rays, or None where they have none.

        Args:
          before, after: states without it and with it. final: that of the whole ray, from a walk
            that may have rounded in another way: floats of the two are not to be compared.
          cotangent: of `final`, with None in place of integers.
        """


class AbstractSum(AbstractCompositor):
    """One whose state is a sum of what pieces add by themselves, whatever the state is by then: its
    cotangent is the same all along the ray, and `add` can be differentiated as it is."""

    def pull_back(self, piece, before, after, final, cotangent):
        def floats(own, rgb, optical_depth, segment):
            state = own.add(before, Piece(rgb, optical_depth, segment, piece.last))
            return [x for x in jax.tree.leaves(state) if jnp.issubdtype(x.dtype, jnp.floating)]

        bars: Any = jax.vjp(floats, self, *piece[:3])[1](jax.tree.leaves(cotangent))
        own_bar, rgb, optical_depth, segment = bars
        return Piece(rgb, optical_depth, segment, None), own_bar


def seen(piece: Piece) -> Array:
    """Segments (R,) that are whole now and are in sight: those of no length are behind the eye, or
    no more than a face. What adds up lengths takes all that are whole, `piece.last`: those of no
    length add nothing, but their derivatives count where a ray passes a vertex or an edge."""
    return piece.last & (piece.segment.length > 0)
