"""What a tracer is."""

from __future__ import annotations

import abc
from typing import Any, Protocol

import jax

from jaxvr.optics.partition import Segment

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


class AbstractTracer(abc.ABC):
    """An ordered stream of segments for each ray."""

    @abc.abstractmethod
    def reversed(self) -> AbstractTracer:
        """A tracer of the same segments from behind: the farthest first, each with its farther end
        as its `front`.

        Raises:
          ValueError: if it has no such way, naming what has.
        """

    @abc.abstractmethod
    def prepare(self, volume: Any) -> Any:
        """The scene: a pytree of what steps gather from. Floats in it depend differentiably on
        those of the volume."""

    @abc.abstractmethod
    def longest(self, scene: Any) -> Array:
        """A bound () on the length of a segment, for integrators whose tables end somewhere."""

    @abc.abstractmethod
    def prepare_rays(self, scene: Any, rays: Any) -> Any:
        """Arrays (R,) of what steps need of `Rays`, differentiable: `near` and `far` too, at which
        the tracer cuts its segments off."""

    @abc.abstractmethod
    def start(self, scene: Any, rays: Any) -> Any:
        """A state in which every ray is waiting."""

    @abc.abstractmethod
    def step(self, scene: Any, rays: Any, state: Any, move: Array) -> Any:
        """Moves the active rays in `move` (R,) to their next segment, and waiting rays to one.

        A ray that is neither active nor waiting stays so, and its segment gets length 0.
        """

    @abc.abstractmethod
    def locate(self, scene: Any, rays: Any, state: Any) -> tuple[Array, Array]:
        """Of the current segments: the cell (R,) int32 that each lies in, and the distance (R,)
        from the ray's origin to its back. Of rays without a segment: anything.

        Raises:
          ValueError: if the tracer does not know.
        """

    @abc.abstractmethod
    def gradient_start(self, scene: Any, rays: Any, perturbed: tuple[Any, Any]) -> tuple[Any, Any]:
        """Zeros to accumulate in, for the scene and for a batch of rays. `perturbed` has the
        structure of (scene, rays), with True at leaves whose gradients are asked for."""

    @abc.abstractmethod
    def pull_back(
        self, scene: Any, rays: Any, state: Any, cotangent: Segment, gradient: tuple[Any, Any]
    ) -> tuple[Any, Any]:
        """`gradient` with the share of the current segments added."""

    @abc.abstractmethod
    def scene_cotangent(self, scene: Any, gradient: Any) -> Any:
        """The accumulated gradient in the form of `scene`; integer leaves are ignored."""

    @abc.abstractmethod
    def rays_cotangent(self, rays: Any, gradient: Any) -> Any:
        """The accumulated gradient in the form of `rays`; integer leaves are ignored."""
