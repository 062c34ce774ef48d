"""What an engine is."""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import jax

from jaxvr.adjoint.base import Asked, Cotangents, Operands, Pipeline

Array = jax.Array


class AbstractEngine(abc.ABC):
    """Runs the loops along rays. An object is a static argument of compiled functions: hashable,
    and equal to another only if the two run alike.

    traceable: whether its loops are JAX's own, which JAX can differentiate as they are.
    confirms_cells: whether it looks itself, as it loads them, at integers of cells that may be out
        of range under a user's `jit`; else they are looked at before.

    In what follows leaves of `operands.rays` are (batches, R), and those of a state
    (batches, ..., R).
    """

    traceable: ClassVar[bool] = False
    confirms_cells: ClassVar[bool] = False

    @abc.abstractmethod
    def refuses(self, pipeline: Pipeline, dtype: Any) -> str | None:
        """None where it can run a pipeline, else why not: a sentence for users.

        Asked outside of `jit`, at every call; dtype: of the volume. `trace` asks for the tracer
        alone: integrator and compositor are None then.
        """

    @abc.abstractmethod
    def march(self, pipeline: Pipeline, operands: Operands) -> tuple[Any, Array]:
        """The compositor's state at the end of each ray, and status (batches, R)."""

    @abc.abstractmethod
    def pull_back(
        self, pipeline: Pipeline, operands: Operands, final: Any, cotangent: Any, asked: Asked
    ) -> Cotangents:
        """Cotangents of what `march` was given.

        Args:
          final: the state that `march` gave, of this engine or another. cotangent: of it, with None
            in place of integers.
        """

    @abc.abstractmethod
    def count(self, tracer: Any, scene: Any, rays: Any) -> tuple[Array, Array]:
        """Of each ray, (batches, R): its number of nodes (see `trace.Segments`), and its status."""

    @abc.abstractmethod
    def fill(self, tracer: Any, scene: Any, rays: Any, start: Array, total: int) -> Any:
        """The nodes, a `trace.recorded.Nodes` of `total`: those of ray r from start[r] on. start is
        (R,), of the first R rays; all after them are copies of the last, which fill a batch."""
