"""What the adjoints promise about modes and memory. That they agree is in test_registry."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import registry

import jaxvr
from experiments.memory import reserved
from jaxvr.volume import datasets

pytestmark = pytest.mark.usefixtures("quick_jit")


@pytest.mark.optimised
@pytest.mark.parametrize("native", [False, True])
def test_memory_of_replay_does_not_grow_with_cells_per_ray(native):
    short, long = (datasets.box((1, 1, n), dtype="float32") for n in (4, 40))
    replay = [reserved(mesh, 32, engine=registry.engine_of(native)) for mesh in (short, long)]
    # Ten times the cells on a ray. What grows is the mesh and the hierarchy over its boundary, of
    # which there are copies; a hundred bytes for each cell of each ray would be 10 MB.
    boxes = jax.eval_shape(lambda m: jaxvr.RayCast().prepare(m).boxes, long)
    hierarchy = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(boxes))
    assert replay[1] - replay[0] < 2 * (long.nbytes + hierarchy)


@pytest.mark.optimised
def test_memory_of_direct_does():
    mesh = datasets.box((1, 1, 4), dtype="float32")
    few, many = (reserved(mesh, 32, jaxvr.Direct(max_steps=n)) for n in (16, 64))
    assert many > 2.5 * few


@pytest.fixture(scope="module")
def image():
    mesh, camera = registry.mesh_of("point", "float64"), registry.camera_of("float64")

    def of(transfer, adjoint):
        return jaxvr.render(mesh, camera, transfer, adjoint=adjoint)

    return of


def test_modes_that_an_adjoint_does_not_have_are_errors(image):
    transfer = registry.transfer_of("float64")
    with pytest.raises(TypeError, match=r"adjoint=Forward\(\), or with adjoint=Direct"):
        jax.jit(lambda t: jax.jvp(lambda t: image(t, jaxvr.Replay()), (t,), (t,)))(transfer)
    with pytest.raises(TypeError, match=r"adjoint=Replay\(\), the default, or with adjoint=Direct"):
        jax.jit(jax.grad(lambda t: image(t, jaxvr.Forward()).sum()))(transfer)


class Own:
    """A user's own adjoint with a `custom_vjp`, and no base."""

    def run(self, pipeline, operands, engine):
        replay = jaxvr.Replay()
        own = jax.custom_vjp(lambda x: replay.run(pipeline, x, engine))
        own.defvjp(lambda x: (own(x), None), lambda _, bar: (None,))
        return own(operands)


@pytest.mark.parametrize(
    "adjoint, words", [(jaxvr.Replay(), r"Replay gives reverse mode"), (Own(), "custom_vjp")]
)
def test_errors_of_forward_mode_are_in_the_words_of_the_adjoint_that_was_asked(
    image, adjoint, words
):
    transfer = registry.transfer_of("float64")
    with pytest.raises(TypeError, match=words) as caught:
        jax.jit(jax.jacfwd(lambda x: image(transfer.scaled(x), adjoint)))(1.0)
    assert isinstance(adjoint, jaxvr.Replay) or "Replay gives" not in str(caught.value)


def test_jacobian_and_gradient_under_vmap(image):
    """grad of a vmap is the sum of a vmap of grads."""
    transfer = registry.transfer_of("float64")
    scales = jnp.array([0.5, 1.0, 2.0])

    def loss(scale):
        return jnp.sum(image(transfer.scaled(scale), jaxvr.Replay()) ** 2)

    each = jax.jit(jax.vmap(jax.grad(loss)))(scales)
    at_once = jax.jit(jax.grad(lambda s: jax.vmap(loss)(s).sum()))(scales)
    assert np.allclose(each, at_once, rtol=1e-12)
    alone = float(jax.jit(jax.grad(loss))(scales[1]))
    assert float(each[1]) == pytest.approx(alone, rel=1e-12)


def test_nothing_to_differentiate_is_no_error(image):
    transfer = registry.transfer_of("float64")
    zero = jax.grad(lambda x: image(transfer, jaxvr.Replay()).sum() + x)(1.0)
    assert float(zero) == 1.0
