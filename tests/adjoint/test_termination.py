"""Rays that end early: the bound on the image, the schedule, and the gradient of what is left."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quick
import registry

import jaxvr
from jaxvr.composite.over import Over
from jaxvr.numerics import compensated
from jaxvr.volume import datasets
from tests.adjoint.schedule import iterations

pytestmark = pytest.mark.usefixtures("quick_code")

LIMIT = 0.05
WEIGHTS = jnp.asarray(np.random.default_rng(1).normal(size=(5, 6, 4)))


@functools.cache
def thick(dtype: str):
    """A box of 162 tetrahedra with an optical depth of some 30, seen by 30 rays."""
    mesh = datasets.box((3, 3, 3), jitter=0.2, seed=1, dtype=dtype)
    camera = jaxvr.Camera.look_at(
        (1.9, 1.4, 2.3), (0.52, 0.47, 0.5), fov=20.0, width=6, height=5, dtype=dtype
    )
    return mesh, camera, registry.transfer_of(dtype).scaled(20.0)


@functools.cache
def segments_of(dtype: str):
    return jaxvr.trace(*thick(dtype)[:2])


@functools.cache
def image_of(termination: float, dtype: str, how: str):
    mesh, camera, transfer = thick(dtype)
    over = Over(termination)
    if how == "shade":
        return np.asarray(jaxvr.shade(segments_of(dtype), transfer, compositor=over))
    return np.asarray(jaxvr.render(mesh, camera, transfer, compositor=over))


@pytest.mark.parametrize("how, termination", [("render", LIMIT), ("shade", 0.5), ("shade", 1e-3)])
def test_image_is_within_the_bound(how, termination, dtype):
    exact, image = image_of(0.0, dtype, how), image_of(termination, dtype, how)
    color, rounding = float(np.max(thick(dtype)[2].colors)), 4 * np.finfo(dtype).eps
    missing = exact - image
    assert np.max(np.abs(missing[..., :3])) <= termination * color + rounding
    assert np.min(missing[..., 3]) >= -rounding
    # Something is really left out, on most rays.
    assert np.median(missing[..., 3]) > 1e-3 * termination
    assert np.max(missing[..., 3]) <= termination + rounding


def test_zero_is_off_and_the_smallest_number_changes_no_bit():
    assert Over().done(Over().init(3, jnp.float32)) is None
    assert Over() == Over(0.0)
    for how in ("render", "shade"):
        assert np.array_equal(image_of(0.0, "float64", how), image_of(1e-300, "float64", how))


@pytest.mark.parametrize("how", ["render", "shade"])
def test_a_batch_takes_fewer_iterations(how):
    mesh, camera, transfer = thick("float32")
    rays = tuple(x.reshape(-1, 3) for x in camera.rays())
    volume = mesh if how == "render" else segments_of("float32")
    all_of_them, some, few = (
        int(iterations(jaxvr.Analytic(), Over(t), False, volume, rays, transfer))
        for t in (0.0, 1e-3, 0.5)
    )
    assert few < some < all_of_them
    assert some <= 0.6 * all_of_them and few <= 0.4 * all_of_them


@pytest.mark.parametrize("how", ["render", "shade"])
def test_gradient_is_that_of_the_truncated_image(how):
    """Against differences along one direction in all parameters; steps are small enough that no
    ray ends in another cell."""
    mesh, camera, transfer = thick("float64")
    segments = segments_of("float64")

    def loss(args):
        if how == "shade":
            scalar, length, tf = args
            volume = dataclasses.replace(segments, scalar=scalar, length=length)
            image = jaxvr.shade(volume, tf, compositor=Over(LIMIT))
        else:
            values, points, tf = args
            volume = mesh.replace(values=values, points=points)
            image = jaxvr.render(volume, camera, tf, compositor=Over(LIMIT))
        return jnp.sum(WEIGHTS * image**2)

    args: Any = (segments.scalar, segments.length, transfer)
    if how == "render":
        args = (mesh.values, mesh.points, transfer)
    leaves, structure = jax.tree.flatten(args)
    rng = np.random.default_rng(2)
    way = [jnp.asarray(rng.normal(size=x.shape)) for x in leaves]
    way[2] = way[2].at[3].set(way[2][2])  # both points of the jump together
    if how == "shade":  # a jump in the scalar is a node of length 0, and has to stay one
        way[1] = jnp.where(leaves[1] == 0, 0, way[1])

    value = quick.jit(loss)

    def at(h):
        moved = [x + h * w for x, w in zip(leaves, way, strict=True)]
        return float(value(structure.unflatten(moved)))

    bars = jax.tree.leaves(quick.jit(jax.grad(loss))(args))
    slope = float(sum(jnp.sum(b * w) for b, w in zip(bars, way, strict=True)))
    coarse, fine = ((at(h) - at(-h)) / (2 * h) for h in (2e-6, 1e-6))
    assert slope == pytest.approx((4 * fine - coarse) / 3, rel=1e-6)


@dataclasses.dataclass(frozen=True)
class Witness:
    """Another compositor, which shows the depths that the backward pass comes by."""

    over: Over
    seen: list = dataclasses.field(default_factory=list, compare=False)
    backwards = False
    shades = True

    def __getattr__(self, name):
        return getattr(self.over, name)

    def pull_back(self, piece, before, after, final, cotangent):
        jax.debug.callback(
            lambda *x: self.seen.append([np.asarray(a) for a in x]),
            *(compensated.value(after.depth), compensated.value(final.depth), self.done(final)),
        )
        return self.over.pull_back(piece, before, after, final, cotangent)


def test_the_replay_ends_rays_where_they_ended(dtype):
    """The optical depth that the backward pass comes to is that of the forward pass, to the bit."""
    segments, transfer = segments_of(dtype), thick(dtype)[2]
    witness: Any = Witness(Over(LIMIT))

    def loss(transfer):
        return jnp.sum(jaxvr.shade(segments, transfer, compositor=witness))

    jax.block_until_ready(jax.grad(loss)(transfer))
    jax.effects_barrier()
    after, final, ended = (np.stack(x) for x in zip(*witness.seen, strict=True))
    assert ended.all()
    assert np.array_equal(after.max(0), final[0])


@pytest.mark.parametrize("termination", [-0.1, 1.0, 2, float("nan"), "0.1", [0.1], np.zeros(2)])
def test_bad_thresholds_are_errors(termination):
    with pytest.raises(ValueError, match=r"termination must be a number in \[0, 1\), but is"):
        Over(termination)
