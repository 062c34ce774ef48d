"""Pictures and gradients do not depend on the user's units: the same bits for scalars, lengths and
extinctions times powers of two over the range that `jaxvr.units` states, and words outside."""

from __future__ import annotations

import dataclasses
import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import registry

import jaxvr
from experiments.units import POWERS, Setting
from jaxvr._core.units import SMALL, exponent_of, near_one, power_of_two

pytestmark = [pytest.mark.optimised, pytest.mark.usefixtures("quick_code")]


def setting_of(dtype: str, parallel: bool = False) -> Setting:
    return Setting(dtype, parallel, blocks=(2, 2, 2), width=6, height=5)


def exponents(dtype: str) -> list[int]:
    b = SMALL[dtype]
    return [-b + 1, -b // 2, -7, 7, b // 2, b - 2]  # the box is 1.2 units large


def steps(dtype: str) -> list[tuple[int, int]]:
    both = list(zip(exponents(dtype), reversed(exponents(dtype))))
    alone = [(k, 0) for k in exponents(dtype)] + [(0, k) for k in exponents(dtype)]
    return [*alone, *both]


@pytest.mark.parametrize("parallel", [False, True], ids=["pinhole", "parallel"])
@pytest.mark.parametrize("native", [True, False], ids=["compiled", "jax"])
def test_picture_has_the_same_bits_in_any_unit(dtype, parallel, native):
    setting, engine = setting_of(dtype, parallel), registry.engine_of(native)
    want = np.asarray(setting.render(setting.scaled(), engine=engine))
    assert np.ptp(want[..., 3]) > 0.5
    for scalar, length in steps(dtype):
        got = setting.render(setting.scaled(scalar, length), engine=engine)
        np.testing.assert_array_equal(got, want, err_msg=f"{scalar}, {length}")


def test_traced_segments_and_probes_have_the_same_bits(dtype):
    setting = setting_of(dtype)
    want = None
    for scalar, length in [(0, 0), *steps(dtype)]:
        mesh, camera, transfer = setting.parts(setting.scaled(scalar, length))
        segments = jaxvr.trace(mesh, camera)
        probe = jaxvr.probe(mesh, camera, transfer, (2, 3))
        back = [-setting.power(k, scalar, length) for k in ("values", "points")]
        got = [
            jaxvr.shade(segments, transfer),
            np.ldexp(segments.scalar, back[0]),
            np.ldexp(segments.length, back[1]),
            np.ldexp(probe.scalars, back[0]),
            np.ldexp(probe.distances, back[1]),
            probe.contributions,
        ]
        got = [np.asarray(x) for x in got]
        want = got if want is None else want
        for a, b in zip(got, want, strict=True):
            np.testing.assert_array_equal(a, b, err_msg=f"{scalar}, {length}")


def test_gradients_have_the_same_bits_in_any_unit(dtype):
    """Those by a number in another unit are in one over it."""
    setting = setting_of(dtype)
    weights = jnp.asarray(np.random.default_rng(1).normal(size=(5, 6, 4)), dtype)

    @jax.jit
    def slopes(numbers):
        return jax.grad(lambda n: (setting.render(n) * weights).sum())(numbers)

    want = slopes(setting.scaled())
    for name, x in want.items():
        assert np.abs(x).max() > 0, name
    for scalar, length in steps(dtype):
        got = slopes(setting.scaled(scalar, length))
        for name, x in got.items():
            x = np.ldexp(np.asarray(x), setting.power(name, scalar, length))
            np.testing.assert_array_equal(x, want[name], err_msg=f"{name}: {scalar}, {length}")
    # Above, those by scalars would underflow: NaN, where 0 would be taken for an answer.
    for scalar in (SMALL[dtype] + 1, SMALL[dtype] + 20):
        for name, x in slopes(setting.scaled(scalar)).items():
            if name in ("values", "positions"):
                assert np.isnan(x).all(), name
            else:
                np.testing.assert_array_equal(x, want[name], err_msg=name)


@pytest.mark.parametrize("native", [True, False])
def test_out_of_range_is_told(dtype, native):
    setting, engine = setting_of(dtype), registry.engine_of(native)
    b = SMALL[dtype]
    for exponent in (-b - 1, -b - 20):
        numbers = setting.scaled(exponent, 0)
        with pytest.raises(jaxvr.RenderError, match="scalars are too small.*unit.*values"):
            setting.render(numbers, engine=engine)
    for exponent in (-b - 1, b + 1, b + 20):
        numbers = setting.scaled(0, exponent)
        with pytest.raises(jaxvr.RenderError, match="lengths are too small or too large.*unit"):
            setting.render(numbers, engine=engine)


@pytest.mark.parametrize("adjoint", [jaxvr.Direct(40), jaxvr.Forward()])
def test_derivatives_out_of_range_are_nan_in_forward_mode_too(adjoint):
    setting = Setting("float32")

    inside, outside = (setting.scaled(k) for k in (20, 101))
    one = {k: jnp.asarray(x) for k, x in inside.items()}
    other = {k: jnp.asarray(x) for k, x in outside.items()}

    @functools.partial(jax.jit, static_argnums=1)
    def along(numbers, name):
        def image(x):
            return setting.render(numbers | {name: x}, adjoint=adjoint)

        return jax.jvp(image, (numbers[name],), (numbers[name],))[1]

    assert np.isfinite(along(one, "values")).all() and np.isnan(along(other, "values")).any()
    np.testing.assert_array_equal(along(one, "colors"), along(other, "colors"))


def test_out_of_range_is_told_by_all_verbs():
    setting = setting_of("float32")
    mesh, camera, transfer = setting.parts(setting.scaled(-101, 0))
    segments = jaxvr.trace(*setting.parts(setting.scaled())[:2])
    small = dataclasses.replace(segments, scalar=segments.scalar * np.float32(2.0**-101))
    origins, directions = (np.asarray(x).reshape(-1, 3)[:2] for x in camera.rays())
    for call in (
        lambda: jaxvr.render_rays(mesh, origins, directions, transfer),
        lambda: jaxvr.trace(mesh, camera),
        lambda: jaxvr.shade(small, transfer),
        lambda: jaxvr.probe(mesh, camera, transfer, (2, 3)),
    ):
        with pytest.raises(jaxvr.RenderError, match="scalars are too small"):
            call()
    # Under jit it is in the status.
    _, bits = jax.jit(lambda m: jaxvr.render(m, camera, transfer, status=True))(mesh)
    with pytest.raises(jaxvr.RenderError, match="scalars are too small"):
        jaxvr.check(bits)


def test_subnormal_numbers_are_not_taken_for_a_field_of_zeros():
    setting = setting_of("float32")
    numbers = setting.scaled()
    numbers["values"] = np.ldexp(numbers["values"], -130)
    numbers["positions"] = np.ldexp(numbers["positions"], -130)
    with pytest.raises(jaxvr.RenderError, match="scalars are too small"):
        setting.render(numbers)


def test_large_scalars_and_any_ratio_of_field_and_positions():
    """The field has no upper bound but the largest float, and may be far from the positions."""
    setting = setting_of("float32")
    want = setting.render(setting.scaled())
    np.testing.assert_array_equal(setting.render(setting.scaled(126, 0)), want)
    for up, down in ((100, -20), (-90, 30), (0, -99), (127, -100)):
        numbers = setting.scaled()
        numbers["values"] = np.ldexp(numbers["values"] + np.float32(0.5), up - 1)
        numbers["positions"] = np.ldexp(numbers["positions"], down)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", jaxvr.ViewWarning)
            assert np.isfinite(setting.render(numbers)).all()


def test_extinctions_to_the_largest_float():
    setting = setting_of("float32")
    numbers = setting.scaled(0, 6)
    numbers["extinctions"] = np.full(6, np.finfo(np.float32).max, np.float32)
    image = np.asarray(setting.render(numbers))
    assert np.isfinite(image).all() and image[..., 3].max() == 1


def test_in_the_units_of_physics():
    """Cross-sections in square metres, energies in joules, a cell of a crystal, a galaxy."""
    setting = setting_of("float64")
    want = np.asarray(setting.render(setting.scaled()))
    for scalar, length in ((1e-28, 1.0), (4e-21, 1.0), (1e-24, 5e-10), (1e38, 9e20)):
        numbers = {k: x.copy() for k, x in setting.scaled().items()}
        for name, (of_scalar, of_length) in POWERS.items():
            numbers[name] = numbers[name] * scalar**of_scalar * length**of_length
        np.testing.assert_allclose(setting.render(numbers), want, atol=1e-12)


def test_powers_of_two():
    for dtype in ("float32", "float64"):
        info = np.finfo(dtype)
        for x in (1.0, 0.5, 3.0, info.tiny, info.max, info.smallest_normal * 3):
            size = jnp.asarray([0, -x], dtype)
            exponent = int(exponent_of(size))
            assert exponent == np.frexp(np.asarray(x, dtype))[1]
            unit = float(near_one(size))
            assert np.frexp(unit)[0] == 0.5 and 0.5 <= x * unit < 4
            assert float(power_of_two(jnp.int32(exponent), dtype)) > 0
        assert float(near_one(jnp.zeros(3, dtype))) == 1


def test_segments_of_a_view_past_the_mesh_have_no_unit(dtype):
    """All lengths are 0, which is no small length."""
    mesh = jaxvr.datasets.box((1, 1, 1), field=lambda p: p[:, 0], dtype=dtype)
    camera = jaxvr.Camera.look_at((0, 0, 9), (0, 0, 20), width=4, height=3, dtype=dtype)
    image = jaxvr.shade(jaxvr.trace(mesh, camera), jaxvr.default_transfer(mesh))
    assert not np.asarray(image).any()
