"""What a fit of a transfer function belongs to, for `differences` to compare."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxvr.fit import digest
from jaxvr.fit.differences import environment
from jaxvr.trace import Segments
from jaxvr.view.camera import Camera


def belongs(
    settings: dict[str, Any],
    objective: Any,
    nouns: tuple[Any, Any, Any],
    scene: tuple[Any, list[Any], Any],
    start: tuple[Any, Any],
    weights: list[Callable[[int], float]],
) -> Callable[[int], dict[str, Any]]:
    """A function from a number of iterations to what the state after them belongs to.

    nouns: integrator, compositor and adjoint as given. scene: volume, cameras, `Views`. start:
    `Parameters` and background. weights: schedules, of which those iterations count that were made.
    """
    (volume, cameras, views), (parameters, background) = scene, start
    given: dict[str, Any] = dict(zip(("integrator", "compositor", "adjoint"), nouns, strict=True))
    given["tracer"] = objective.tracer
    named = {name: digest.plain(noun)[:200] for name, noun in given.items()}
    digests: dict[str, Any] = {name: digest.data(noun) for name, noun in given.items()}
    if volume is not None:
        # Fields without the report, which says how they came about.
        for field in dataclasses.fields(volume):
            if field.name != "report":
                digests[f"volume.{field.name}"] = digest.data(getattr(volume, field.name))
    dtype = views.targets.dtype
    digests["cameras"] = [digest.data(_view(c, dtype)) for c in cameras]
    digests["targets"] = [digest.data(t) for t in views.split(views.targets)]
    digests["the start"] = digest.data(parameters.transfer)
    transforms = parameters.transforms
    digests["transforms"] = digest.data([transforms, jax.tree.leaves(transforms)])
    digests["background"] = digest.data(background)
    colors = views.targets.shape[1:]
    rays = jax.ShapeDtypeStruct((settings["rays"], *colors), dtype)
    made: dict[str, str] = {}

    def programs() -> dict[str, str]:
        if not made:
            made["loss"] = digest.program(lambda a, b: objective.loss(a, b), rays, rays)
            if views.cached:
                made["the traced segments"] = digest.data([views.nodes, views.first, views.end])
        return dict(made)

    values: list[list[float]] = []

    def about(done: int) -> dict[str, Any]:
        values.extend([w(i) for w in weights] for i in range(len(values), done))
        smooth = {"smoothness in the iterations made": digest.data(values[:done])}
        return {
            **settings,
            **named,
            "digests": digests | smooth,
            "programs": programs(),
            "environment": environment(loops=digest.plain(objective.engine)),
        }

    return about


def _view(camera: Any, dtype: Any) -> Any:
    """A camera in the dtype that it is used in; of segments what is in use of their buffers."""
    if isinstance(camera, Segments):
        used = int(np.asarray(camera.start)[-1])
        nodes = camera.scalar[:used], camera.length[:used]
        return nodes, camera.start, camera.order, camera.shape, camera.offset
    if not isinstance(camera, Camera):
        return [np.asarray(x) for x in camera.rays()]
    return jax.tree.map(lambda x: jnp.asarray(x).astype(dtype), camera)
