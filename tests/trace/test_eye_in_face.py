"""Gradients where an eye lies in a face between two cells, exactly or but for rounding.

The picture is smooth there: a cell ends at the eye, and the next begins. The derivative is shared
by both, and each of the two finds the depth of the face, which is 0 but for rounding, by itself.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxvr

pytestmark = pytest.mark.usefixtures("quick_code")

HOW = {
    "compiled": {},
    "jax": {"engine": jaxvr.engine.XLA()},
    "k-buffer": {"tracer": jaxvr.KBuffer(k=12)},
    "from behind": {
        "tracer": jaxvr.KBuffer(k=12),
        "compositor": jaxvr.Over(direction="back to front"),
    },
    "forward": {"adjoint": jaxvr.Forward()},
}


@pytest.fixture(scope="module", name="scene")
def _scene():
    """A mesh, a transfer function and rays from eyes in its inner faces."""
    mesh = jaxvr.datasets.box((2, 2, 2), 0.2, dtype="float64")
    mesh = mesh.replace(values=np.sin(3 * np.asarray(mesh.points)).sum(axis=1))
    transfer = jaxvr.TransferFunction([-3.0, 0.5, 3.0], np.eye(3), [2.0, 5.0, 3.0], dtype="float64")
    rng = np.random.default_rng(11)
    cells, words = np.asarray(mesh.cells), np.asarray(mesh.neighbors)
    cell, corner = np.nonzero(words >= 0)
    some = rng.choice(len(cell), 24, replace=False)
    faces = np.stack([np.delete(cells[c], k) for c, k in zip(cell[some], corner[some])])
    # Thirds and quarters: weights that are exact, and such that are not.
    weights = np.array([[0.5, 0.25, 0.25], [1 / 3, 1 / 3, 1 / 3]])[np.arange(24) % 2]
    eyes = np.einsum("rk,rkx->rx", weights, np.asarray(mesh.points)[faces])
    directions = rng.normal(size=(24, 3))
    return mesh, transfer, eyes, directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("name", HOW)
def test_by_the_eye_and_the_points(scene, name, quick_jit):
    mesh, transfer, eyes, directions = scene
    how = HOW[name]
    rng = np.random.default_rng(2)
    weights, along = rng.normal(size=(len(eyes), 4)), rng.normal(size=eyes.shape)
    move = 0.3 * rng.normal(size=mesh.points.shape)

    @jax.jit
    def seen(h, k):
        moved = mesh.replace(points=mesh.points + k * move)
        rgba = jaxvr.render_rays(moved, eyes + h * along, directions, transfer, **how)
        return (rgba * weights).sum(axis=1)

    if name == "forward":
        slopes = [
            jax.jvp(lambda x: seen(*x), ((0.0, 0.0),), (t,))[1] for t in ((1.0, 0.0), (0.0, 1.0))
        ]
    else:
        grads = jax.jit(jax.jacrev(seen, (0, 1)))(0.0, 0.0)
        slopes = list(grads)
    for slope, shift in zip(slopes, (jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))):

        def central(step, shift=shift):
            return (seen(*(step * shift)) - seen(*(-step * shift))) / (2 * step)

        # The second derivative jumps there, which leaves an error in proportion to the step.
        expected = 2 * central(1e-6) - central(2e-6)
        assert np.abs(expected).max() > 0.1
        np.testing.assert_allclose(slope, expected, rtol=0, atol=1e-7 * np.abs(expected).max())


def test_one_ray_alone(scene):
    """Whatever the other rays of its batch are in."""
    mesh, transfer, eyes, directions = scene
    engine = jaxvr.engine.XLA()

    def gradient(eyes, directions):
        def total(eyes):
            return jaxvr.render_rays(mesh, eyes, directions, transfer, engine=engine).sum()

        return jax.grad(total)(eyes)

    together = gradient(jnp.asarray(eyes), directions)
    for k in range(4):
        alone = gradient(jnp.asarray(eyes[k : k + 1]), directions[k : k + 1])
        np.testing.assert_allclose(alone[0], together[k], rtol=1e-12, atol=1e-12)
