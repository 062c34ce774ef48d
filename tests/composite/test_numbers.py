"""Numbers of nouns are leaves: new ones compile nothing, and have derivatives, by all adjoints."""

from __future__ import annotations

import dataclasses
import functools
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import registry

import jaxvr
from jaxvr.composite import AbstractCompositor, AbstractSum, Over
from jaxvr.optics.integrator import AbstractSlabIntegrator

pytestmark = pytest.mark.usefixtures("quick_jit")

XLA = jaxvr.engine.XLA()
WEIGHTS = jnp.asarray(np.random.default_rng(1).normal(size=(5, 6, 4)))
ADJOINTS = [jaxvr.Replay(), jaxvr.Direct(64), jaxvr.Forward()]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Lit(AbstractSum):
    """Light times a gain, and more of it where the scalar is above a level; on a ground."""

    gain: Any = 1.0
    level: Any = 0.5
    ground: Any = 0.0
    sharp: float = dataclasses.field(default=9.0, metadata={"static": True})

    needs = frozenset({"rgb", "scalar"})  # pyright: ignore

    def default_integrator(self):
        return jaxvr.Analytic()

    def init(self, rays, dtype):
        return jnp.zeros((3, rays), dtype)

    def add(self, state, piece):
        front, back, length = piece.segment
        above = jax.nn.sigmoid(self.sharp * (0.5 * (front + back) - self.level))
        return state + self.gain * piece.rgb + jnp.where(piece.last, length * above, 0)[None]

    def finish(self, state, transfer, scale):
        return jnp.concatenate([state + self.ground, jnp.ones_like(state[:1])])

    def merge(self, front, back):
        return front + back


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Bright(AbstractCompositor):
    """`Over` with colours times a gain: no sum, and a `pull_back` of its own."""

    gain: Any = 1.0
    over: Over = Over()

    needs = frozenset({"rgb", "optical_depth"})  # pyright: ignore

    def default_integrator(self):
        return jaxvr.Analytic()

    def init(self, rays, dtype):
        return self.over.init(rays, dtype)

    def add(self, state, piece):
        return self.over.add(state, piece._replace(rgb=self.gain * piece.rgb))

    def done(self, state):
        return self.over.done(state)

    def finish(self, state, transfer, scale):
        return self.over.finish(state, transfer, scale)

    def merge(self, front, back):
        return self.over.merge(front, back)

    def pull_back(self, piece, before, after, final, cotangent):
        bar, _ = self.over.pull_back(piece, before, after, final, cotangent)
        zero = jax.tree.map(jnp.zeros_like, self)
        own = dataclasses.replace(zero, gain=jnp.sum(bar.rgb * piece.rgb))
        return bar._replace(rgb=self.gain * bar.rgb), own


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Stained(AbstractSlabIntegrator):
    """`Analytic` with more of the colour in front."""

    more: Any = 0.0

    def weights(self, a, b):
        w, back = jaxvr.Analytic().weights(a, b)
        return w * (1 + self.more), back * (1 - self.more * w)


@functools.cache
def segments():
    with jax.ensure_compile_time_eval():  # a constant, also where it is first wanted by a `jit`
        return jaxvr.trace(registry.mesh_of("point", "float64"), registry.camera_of("float64"))


def seen(nouns, adjoint=None, colors=None, engine=XLA):
    transfer = registry.transfer_of("float64")
    transfer = transfer if colors is None else transfer.replace(colors=colors)
    image = jaxvr.shade(segments(), transfer, adjoint=adjoint, engine=engine, **nouns)
    return jnp.sum(WEIGHTS * image)


def behind(number):
    return {"integrator": Stained(number), "compositor": Over(direction="back to front")}


NUMBERS = {
    "gain of a sum": (lambda x: {"compositor": Lit(x)}, 1.3),
    "level": (lambda x: {"compositor": Lit(0.7, level=x)}, 0.4),
    "what finish adds": (lambda x: {"compositor": Lit(ground=x)}, 0.2),
    "gain and termination": (lambda x: {"compositor": Bright(x, Over(0.4))}, 1.3),
    "integrator": (lambda x: {"integrator": Stained(x)}, 0.3),
    "integrator from behind": (behind, 0.3),
}


@pytest.mark.parametrize("adjoint", ADJOINTS, ids=lambda a: type(a).__name__)
@pytest.mark.parametrize("name", NUMBERS)
def test_derivatives_by_numbers(name, adjoint):
    nouns, at = NUMBERS[name]

    def value(x):
        return seen(nouns(x), adjoint)

    forward = isinstance(adjoint, jaxvr.Forward)
    slope = jax.jit(jax.jacfwd(value) if forward else jax.grad(value))(at)
    h = 1e-4
    fine, coarse = ((value(at + k * h) - value(at - k * h)) / (2 * k * h) for k in (1, 2))
    assert abs(slope) > 1e-2
    assert float(slope) == pytest.approx(float(4 * fine - coarse) / 3, rel=1e-8)


def test_a_gradient_by_numbers_is_that_in_any_company():
    """With and without colours, in any order of asking, in one process."""

    def value(gain, colors):
        return seen({"compositor": Bright(gain)}, colors=colors)

    at = jnp.asarray(1.3), registry.transfer_of("float64").colors
    found = []
    for order in ((0, 1, (0, 1)), ((0, 1), 1, 0), (1, 0, (0, 1))):
        jax.clear_caches()
        pulls = [(which, jax.vjp(value, *at)[1]) for which in order]
        gradients = {which: jax.grad(value, which)(*at) for which in order}
        both = pulls[0][1](jnp.ones(()))
        found.append((gradients[0], gradients[1], *gradients[0, 1], *both))
    for got in found:
        for x, y in zip(got, (*found[0][:2],) * 3, strict=True):
            assert np.array_equal(x, y) and np.max(np.abs(x)) > 0.1


def test_numbers_compile_nothing():
    mesh, camera = registry.mesh_of("point", "float32"), registry.camera_of("float32")
    transfer = registry.transfer_of("float32")
    draw = sys.modules["jaxvr.render"]._render
    for engine in (jaxvr.engine.C(), XLA):
        before, images = draw._cache_size(), []
        for number in (0.1, 0.2, np.float32(0.5), 0.9):
            compositor = jaxvr.Over(termination=number)
            images.append(
                jaxvr.render(mesh, camera, transfer, compositor=compositor, engine=engine)
            )
        assert draw._cache_size() == before + 1
        assert images[0].dtype == np.float32
        for image, other in zip(images[:-1], images[1:], strict=True):
            assert not np.array_equal(image, other)
    before = draw._cache_size()
    for gain in (1, 1.5, np.float64(2)):
        jaxvr.render(mesh, camera, transfer, compositor=Lit(gain))
    assert draw._cache_size() == before + 1


def test_numbers_compile_nothing_in_fits():
    mesh, camera = registry.mesh_of("point", "float32"), registry.camera_of("float32")
    transfer = registry.transfer_of("float32")
    image = jaxvr.render(mesh, camera, transfer)
    gradient = sys.modules["jaxvr.fit.fit"]._gradient
    before = gradient._cache_size()
    for number in (0.1, 0.2):
        jaxvr.fit(
            *(transfer, mesh, camera, image),
            compositor=Over(number),
            iterations=1,
            progress=False,
        )
    assert gradient._cache_size() == before + 1


def test_none_and_zero_are_one():
    assert Over(0) == Over(0.0) == Over(None) == Over()
    assert Over(0).termination is None and len({Over(0), Over(), Over(0.5), Over(0.5)}) == 2
    assert repr(Over(0)) == "Over(termination=None, direction='front to back')"
    assert jax.tree.leaves(Over()) == [] and jax.tree.leaves(Over(0.5)) == [0.5]
    # What JAX rebuilds is not checked: there may be anything in place of numbers.
    assert jax.tree.map(lambda _: "placeholder", Over(0.5)).termination == "placeholder"
    assert jax.tree.map(lambda _: 0, Over(0.5)).termination == 0
    for every in (registry.TRACERS, registry.INTEGRATORS, registry.COMPOSITORS):
        for entry in every:
            made = entry.make()
            assert jax.tree.map(lambda x: x, made) == made == entry.make()
            assert hash(made) == hash(entry.make())


@pytest.mark.parametrize("adjoint", ADJOINTS, ids=lambda a: type(a).__name__)
def test_by_termination_there_is_no_derivative(adjoint):
    def value(x):
        return seen({"compositor": Over(x)}, adjoint)

    forward = isinstance(adjoint, jaxvr.Forward)
    with pytest.raises(TypeError, match="made of steps"):
        (jax.jacfwd(value) if forward else jax.grad(value))(0.3)
    seen({"compositor": Over(jnp.asarray(0.3))}, adjoint)  # an array is a number


@dataclasses.dataclass(frozen=True)
class Plain(Over):
    """Of a user who registers nothing."""

    gain: Any = 1.0

    def add(self, state, piece):
        return super().add(state, piece._replace(rgb=self.gain * piece.rgb))


def test_what_is_not_registered_is_static_or_told():
    assert float(seen({"compositor": Plain(gain=1.0)})) == float(seen({}))
    assert float(seen({"compositor": Plain(gain=2.0)})) != float(seen({}))
    words = "is a Plain that {}, and no pytree.*register_dataclass"
    with pytest.raises(ValueError, match=words.format("holds arrays")):
        jax.grad(lambda x: seen({"compositor": Plain(gain=x)}))(1.0)
    with pytest.raises(ValueError, match=words.format("holds arrays")):
        jax.grad(lambda x: seen({"compositor": Plain(gain=Over(x))}))(0.1)
    with pytest.raises(ValueError, match=words.format(r"cannot be hashed \(unhashable.*\)")):
        seen({"compositor": Plain(gain=np.ones(3))})
    with pytest.raises(ValueError, match="compositor has 'loud' in a field.*'static': True"):
        seen({"compositor": Lit("loud")})


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Late(Lit):
    """Uses a number where a replay cannot follow."""

    def init(self, rays, dtype):
        return super().init(rays, dtype) + self.ground


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Silent(Bright):
    def pull_back(self, piece, before, after, final, cotangent):
        return super().pull_back(piece, before, after, final, cotangent)[0], None


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Stretched(jaxvr.RayCast):
    """Scalars times a number, by the scene, and lengths times one, in steps."""

    scalars: Any = 1.0
    lengths: Any = None

    def prepare(self, volume):
        return super().prepare(dataclasses.replace(volume, values=self.scalars * volume.values))

    def step(self, scene, rays, state, move):
        state = super().step(scene, rays, state, move)
        if self.lengths is None:
            return state
        segment = state.segment
        return state._replace(segment=segment._replace(length=self.lengths * segment.length))


def test_what_a_replay_cannot_follow_is_refused():
    for make, words in (
        (lambda x: Late(ground=x), "numbers of Late that its init uses"),
        (lambda x: Silent(x), "Silent's pull_back gives no cotangent of its own numbers"),
    ):
        with pytest.raises(TypeError, match=words):
            jax.grad(lambda x, make=make: seen({"compositor": make(x)}))(0.5)
    late = [jax.grad(lambda x: seen({"compositor": Late(gain=x)}, a))(0.5) for a in ADJOINTS[:2]]
    assert np.allclose(*late, rtol=1e-12)


def test_numbers_of_tracers():
    mesh, camera = registry.mesh_of("point", "float64"), registry.camera_of("float64")
    transfer = registry.transfer_of("float64")

    def value(**numbers):
        image = jaxvr.render(mesh, camera, transfer, tracer=Stretched(**numbers), engine=XLA)
        return jnp.sum(WEIGHTS * image)

    slope = jax.grad(lambda x: value(scalars=x))(0.9)
    fine, coarse = (
        (value(scalars=0.9 + h) - value(scalars=0.9 - h)) / (2 * h) for h in (1e-4, 2e-4)
    )
    assert float(slope) == pytest.approx(float(4 * fine - coarse) / 3, rel=1e-6)
    with pytest.raises(TypeError, match="numbers of Stretched that its start or step uses"):
        jax.grad(lambda x: value(lengths=x))(0.9)
