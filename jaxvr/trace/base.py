"""What a tracer is.

A tracer finds and derives. `step` finds: which cell comes next, by integers and by floats that
decide and are held (where a ray was cut, how far it has come); they make a state. What a segment
is, as floats that depend on the volume and the rays, is derived from the state. A tracer that says
how, by `address` and `segment`, has all derivatives by that: `address` names the rows of the
scene's arrays that the segment hangs on, and `segment` is plain arithmetic on these rows, on what
all segments share and on the rays. In reverse mode `jaxvr.adjoint.by_rows` gathers, differentiates
`segment` and scatters, so that a tracer is finished when its forward pass is.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar, Protocol

import jax
import jax.numpy as jnp
from jax import lax

from jaxvr._core.pytree import pytree
from jaxvr.optics.partition import Segment
from jaxvr.volume.base import AbstractVolume

Array = jax.Array


class TraceState(Protocol):
    """What the loops read of a tracer's state, a NamedTuple. All arrays are (R,).

    Loops also end rays, by making them inactive while they have a segment.
    """

    @property
    def segment(self) -> Segment:
        """The current segment; length 0 for rays without one."""
        ...

    @property
    def active(self) -> Array:
        """bool: the ray has a current segment."""
        ...

    @property
    def waiting(self) -> Array:
        """bool: the ray has none, but the next `step` may find one."""
        ...

    @property
    def fresh(self) -> Array:
        """bool: the segment's front scalar is not the back scalar of the one before."""
        ...

    @property
    def status(self) -> Array:
        """int32 bits of `jaxvr._core.status`."""
        ...


@pytree
class Store:
    """The scene of a tracer with `address` and `segment`.

    rows: a pytree of arrays (N, ...), of which segments gather rows. whole: a pytree of arrays that
    all segments share, as the spacing of a grid. held: whatever else steps read, without
    derivatives, as connectivity.
    """

    rows: Any
    whole: Any = ()
    held: Any = ()


class AbstractTracer(abc.ABC):
    """An ordered stream of segments for each ray.

    To write: `prepare`, `prepare_rays`, `start` and `step`, and for reverse mode `address` and
    `segment`, with a `Store` as the scene. (Those of the package that have `pull_back` instead
    do by hand what these two get from JAX.)

    takes: the class of the volumes that it traces. cuts: whether it cuts segments at `near` and
    `far` of rays; else it refuses these.
    """

    takes: ClassVar[type] = AbstractVolume
    cuts: ClassVar[bool] = False

    @abc.abstractmethod
    def prepare(self, volume: Any) -> Any:
        """The scene: a pytree of what steps gather from. Floats in it depend differentiably on
        those of the volume."""

    @abc.abstractmethod
    def prepare_rays(self, scene: Any, rays: Any) -> Any:
        """Arrays (R,) or (..., R) of what steps need of `view.rays.Rays`, differentiable.
        Directions have any length but 0; `near` and `far` are those at which a tracer that `cuts`
        cuts its segments off."""

    @abc.abstractmethod
    def start(self, scene: Any, rays: Any) -> Any:
        """A state in which every ray is waiting."""

    @abc.abstractmethod
    def step(self, scene: Any, rays: Any, state: Any, move: Array) -> Any:
        """Moves the active rays in `move` (R,) to their next segment, and waiting rays to one.

        A ray that is neither active nor waiting stays so, and its segment gets length 0.
        """

    def address(self, state: Any) -> Any:
        """Rows of `scene.rows` that the current segments hang on: a pytree of its structure, of
        int32 (C, R), -1 where there is none."""
        raise ValueError(f"{type(self).__name__} has no address(state).")

    def segment(self, rows: Any, whole: Any, rays: Any, state: Any) -> Segment:
        """The current segments, differentiable in rows, whole and rays.

        Args:
          rows: what `address` names, (C, R, ...), 0 where that is -1. whole: that of the scene.
          state: held. Of rays without a segment the result may be anything that is finite, with
            derivatives that are.
        """
        raise ValueError(f"{type(self).__name__} has no segment(rows, whole, rays, state).")

    def derived(self, scene: Store, rays: Any, state: Any) -> Segment:
        """The current segments by `address` and `segment`, for `step` to put into its state: so
        forward mode, and an adjoint that records, have the derivatives that reverse mode has."""
        state = jax.tree.map(lax.stop_gradient, state)
        return self.segment(gather(scene.rows, self.address(state)), scene.whole, rays, state)

    def reversed(self) -> AbstractTracer:
        """A tracer of the same segments from behind: the farthest first, each with its farther end
        as its `front`.

        Raises:
          ValueError: if it has no such way, naming what has.
        """
        raise ValueError(
            f"{type(self).__name__} gives the nearest segments first, and not the farthest as "
            "compositing back to front wants them. Use shade(trace(volume, camera), ...), which "
            "plays segments in either direction; or composite front to back, for the same picture."
        )

    def longest(self, scene: Any) -> Array | None:
        """A bound () on the length of a segment, for integrators whose tables end somewhere; None
        if there is none, which these refuse."""
        return None

    def locate(self, scene: Any, rays: Any, state: Any) -> tuple[Array, Array, Array]:
        """Of the current segments: the cell (R,) int32 that each lies in, and the distances (R,)
        from the ray's origin to its front and its back, not cut at the ends of the ray: they
        descend where a folded cell leads back. Of rays without a segment: anything.

        Raises:
          ValueError: if the tracer does not know.
        """
        raise ValueError(
            f"{type(self).__name__} has no locate(scene, rays, state): it knows scalars and "
            "lengths of its segments, but not where they are, and so it cannot be probed."
        )

    # By hand, in place of `address` and `segment`. Where neither is written, adjoints say so.

    def gradient_start(self, scene: Any, rays: Any, perturbed: tuple[Any, Any]) -> tuple[Any, Any]:
        """Zeros to accumulate in, for the scene and for a batch of rays. `perturbed` has the
        structure of (scene, rays), with True at leaves whose gradients are asked for."""
        raise self._no_way("gradient_start")

    def pull_back(
        self, scene: Any, rays: Any, state: Any, cotangent: Segment, gradient: tuple[Any, Any]
    ) -> tuple[Any, Any]:
        """`gradient` with the share of the current segments added."""
        raise self._no_way("pull_back")

    def scene_cotangent(self, scene: Any, gradient: Any) -> Any:
        """The accumulated gradient in the form of `scene`; integer leaves are ignored."""
        raise self._no_way("scene_cotangent")

    def rays_cotangent(self, rays: Any, gradient: Any) -> Any:
        """The accumulated gradient in the form of `rays`; integer leaves are ignored."""
        raise self._no_way("rays_cotangent")

    def _no_way(self, name: str) -> ValueError:
        return ValueError(f"{type(self).__name__} has no {name}.")


def gather(rows: Any, address: Any) -> Any:
    """Rows (C, R, ...) of arrays (N, ...) by numbers (C, R) int32, 0 where these are -1."""

    def take(x: Array, i: Array) -> Array:
        there = jnp.reshape(i >= 0, i.shape + (1,) * (x.ndim - 1))
        return jnp.where(there, x[jnp.maximum(i, 0)], jnp.zeros((), x.dtype))

    return jax.tree.map(take, rows, address)
