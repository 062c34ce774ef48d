"""The transfer function against NumPy's interpolation, its checks, and where it comes from."""

from __future__ import annotations

import copy
import pickle

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

from jaxvr.optics.transfer import TransferFunction

P = np.array([-1.0, 0.0, 0.5, 2.0])
C = np.array([[0.1, 0.2, 0.3], [0.9, 0.0, 0.4], [0.5, 0.5, 0.0], [1.0, 0.8, 2.0]])
E = np.array([0.0, 3.0, 1.0, 7.0])
JUMP = (np.array([0.0, 1.0, 1.0, 2.0]), C, E)


def make(dtype="float64", data=(P, C, E)):
    return TransferFunction(*data, dtype=dtype)


def leaves(tf):
    return [np.asarray(x) for x in jax.tree.leaves(tf)]


def test_values_are_piecewise_linear_and_constant_outside(dtype):
    s = np.linspace(-3, 4, 141).reshape(3, 47).astype(dtype)
    colors, extinctions = make(dtype)(s)
    assert colors.dtype == extinctions.dtype == dtype
    assert colors.shape == (3, 47, 3) and extinctions.shape == (3, 47)
    tolerance = 1e-14 if dtype == "float64" else 3e-6
    np.testing.assert_allclose(extinctions, np.interp(s, P, E), atol=tolerance)
    for c in range(3):
        np.testing.assert_allclose(colors[..., c], np.interp(s, P, C[:, c]), atol=tolerance)


def test_control_points_and_extremes_are_exact(dtype):
    tf = make(dtype)
    colors, extinctions = tf(tf.positions)
    np.testing.assert_array_equal(colors, tf.colors)
    np.testing.assert_array_equal(extinctions, tf.extinctions)
    np.testing.assert_array_equal(tf(jnp.array([-jnp.inf, jnp.inf]))[1], E[[0, -1]])
    assert np.isnan(tf(jnp.nan)[1]) and np.isnan(tf(jnp.nan)[0]).all()
    assert tf(1)[1].dtype == dtype  # whole numbers take the function's dtype


def test_jumps_take_the_upper_side(dtype):
    tf = make(dtype, JUMP)
    s = np.array([1.0, np.nextafter(np.dtype(dtype).type(1), 0)], dtype)
    np.testing.assert_allclose(tf(s)[1], [1.0, 3.0], rtol=1e-6)
    np.testing.assert_allclose(tf(s)[0], C[[2, 1]], atol=1e-6)
    ends = TransferFunction([0.0, 0.0, 1.0, 1.0], C, E)
    np.testing.assert_array_equal(ends(np.array([-1.0, 0.0, 1.0, 2.0]))[1], E[[0, 1, 3, 3]])


def test_one_control_point_is_a_constant(dtype):
    tf = TransferFunction([0.5], [[1.0, 0.5, 0.25]], [2.0], dtype=dtype)
    colors, extinctions = tf(np.array([-1.0, 0.5, 3.0], dtype))
    np.testing.assert_array_equal(extinctions, [2, 2, 2])
    np.testing.assert_array_equal(colors, [[1, 0.5, 0.25]] * 3)
    gradient = jax.grad(lambda tf, s: jnp.sum(tf(s)[1]), argnums=(0, 1))(tf, 0.7)
    assert gradient[1] == 0 and gradient[0].positions == 0 and gradient[0].extinctions == 1


def loss(tf, s):
    colors, extinctions = tf(s)
    return jnp.sum(jnp.sin(colors)) + jnp.sum(extinctions**2)


@pytest.mark.parametrize("data", [(P, C, E), JUMP])
def test_gradients_against_finite_differences(data):
    tf, s = make(data=data), jnp.array([-5.0, -0.4, 0.2, 0.45, 0.7, 1.3, 1.9, 9.0])
    got = jax.tree.leaves(jax.grad(loss, argnums=(0, 1))(tf, s))
    flat, tree = jax.tree.flatten((tf, s))
    h = 1e-6
    for k, leaf in enumerate(flat):
        for index in np.ndindex(leaf.shape):
            ends = []
            for sign in (h, -h):
                moved = list(flat)
                moved[k] = leaf.at[index].add(sign)
                ends.append(loss(*jax.tree.unflatten(tree, moved)))
            want = float(ends[0] - ends[1]) / (2 * h)
            assert got[k][index] == pytest.approx(want, rel=1e-7, abs=1e-7)


def test_gradients_are_finite_at_kinks_jumps_and_far_outside(dtype):
    for data in ((P, C, E), JUMP, ([0.0, 0.0], C[:2], E[:2])):
        tf = make(dtype, data)
        tiny = np.finfo(dtype).tiny
        s = jnp.asarray([*tf.positions, -1e30, 1e30, jnp.inf, -jnp.inf, tiny], dtype)
        for leaf in jax.tree.leaves(jax.grad(loss, argnums=(0, 1))(tf, s)):
            assert np.isfinite(leaf).all() and leaf.dtype == dtype
        slopes = jax.vmap(jax.grad(lambda s: tf(s)[1]))(jnp.asarray([-9.0, 9.0], dtype))  # noqa: B023
        np.testing.assert_array_equal(slopes, 0)


def test_at_a_control_point_the_slope_is_that_of_the_interval_above():
    assert jax.grad(lambda s: make()(s)[1])(0.0) == pytest.approx((1 - 3) / 0.5)
    assert jax.grad(lambda s: make()(s)[1])(2.0) == 0


def test_rebuilding_checks_nothing():
    tf = make()
    assert isinstance(jax.tree.map(lambda x: -x, tf), TransferFunction)
    assert jax.tree.unflatten(jax.tree.structure(tf), [None, object(), 3]).extinctions == 3
    stacked = jax.tree.map(lambda x: jnp.stack([x, 2 * x]), tf)
    out = jax.vmap(lambda tf: tf(0.25)[1])(stacked)
    np.testing.assert_allclose(out, [2.0, 2 * np.interp(0.25, 2 * P, E)])
    for again in (copy.deepcopy(tf), pickle.loads(pickle.dumps(tf))):
        for a, b in zip(leaves(tf), leaves(again), strict=True):
            np.testing.assert_array_equal(a, b)
    names = [jax.tree_util.keystr(k) for k, _ in jax.tree_util.tree_leaves_with_path(tf)]
    assert names == [".positions", ".colors", ".extinctions"]


def test_can_be_built_and_changed_under_jit_and_grad():
    def f(extinctions):
        return TransferFunction(P, C, extinctions).scaled(2.0).replace(colors=C)(0.25)[1]

    np.testing.assert_allclose(jax.jit(jax.grad(f))(E), [0, 1, 1, 0])
    with pytest.raises(ValueError, match="extinctions must have shape"):
        jax.jit(f)(E[:3])


@pytest.mark.parametrize(
    "change, message",
    [
        (
            dict(positions=[0.0, 2.0, 1.0, 3.0]),
            r"positions\[2\] = 1 comes after positions\[1\] = 2",
        ),
        (dict(positions=[0.0, 1.0, 1.0, 1.0]), r"positions\[1\], \[2\] and \[3\] are all 1"),
        (dict(positions=[0.0, 1.0, np.nan, 2.0]), "positions has 1 NaN .* index 2"),
        (dict(positions=[]), "at least one control point"),
        (dict(positions=[[0.0]]), "1 dimension"),
        (dict(positions=["a", "b", "c", "d"]), "positions must hold numbers"),
        (dict(colors=C[:3]), r"colors must have shape \(4, 3\), but has \(3, 3\)"),
        (dict(colors=np.ones((4, 4))), "colors must have shape"),
        (dict(colors=[[1, 2, 3], [1, 2], [0], []]), "colors"),
        (dict(colors=np.full((4, 3), np.inf)), "colors has 12 NaN or infinite"),
        (dict(extinctions=[0.0, -1.0, 2.0, -3.0]), r"2 of 4 are, the first extinctions\[1\] = -1"),
        (dict(extinctions=[0.0, np.inf, 0.0, 0.0]), "extinctions has 1"),
        (dict(extinctions=[1.0, 2.0]), "extinctions must have shape"),
        (dict(extinctions=[1j, 0, 0, 0]), "extinctions must"),
    ],
)
def test_bad_functions_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        TransferFunction(**(dict(positions=P, colors=C, extinctions=E) | change))
    if len(next(iter(change.values()))) == 4:
        with pytest.raises(ValueError, match=message):
            make().replace(**change)


def test_dtype_follows_the_arrays():
    narrow = P.astype(np.float32)
    assert TransferFunction(narrow, C.tolist(), E.tolist()).dtype == np.float32
    assert TransferFunction(narrow, C, E).dtype == np.float64
    assert TransferFunction([0, 1], C[:2].tolist(), [1, 2]).dtype == np.float64  # x64 is on
    assert make().astype("float32").dtype == np.float32


def test_from_colormap_by_name_function_and_table(dtype):
    positions = np.array([1.0, 2.0, 5.0], dtype)
    x = [0.0, 0.25, 1.0]
    viridis = matplotlib.colormaps["viridis"]
    for colormap in ("viridis", viridis, lambda x: viridis(x)[:, :3]):
        tf = TransferFunction.from_colormap(colormap, positions, [0, 1, 2])
        np.testing.assert_allclose(tf.colors, viridis(x)[:, :3], rtol=1e-6)
        np.testing.assert_array_equal(tf.extinctions, [0, 1, 2])
        assert tf.dtype == dtype
    table = TransferFunction.from_colormap(
        [[0, 0, 0], [1, 0.5, 0], [1, 1, 1]], positions, [0, 1, 2]
    )
    np.testing.assert_allclose(table.colors, [[0, 0, 0], [0.5, 0.25, 0], [1, 1, 1]])
    light = TransferFunction.from_colormap(
        lambda x: np.full((3, 3), 0.5), positions, E[:3], srgb=True
    )
    np.testing.assert_allclose(light.colors, 0.2140411405, rtol=1e-6)


def test_from_colormap_with_more_points_follows_the_map_and_keeps_the_extinction():
    positions, extinctions = [0.0, 0.3, 0.3, 1.0], [0.0, 4.0, 1.0, 2.0]
    tf = TransferFunction.from_colormap("viridis", positions, extinctions, points=65)
    viridis, s = matplotlib.colormaps["viridis"], np.linspace(0, 1, 129)
    np.testing.assert_allclose(tf(s)[0], viridis(s)[:, :3], atol=0.01)
    plain = TransferFunction(positions, C, extinctions)
    np.testing.assert_allclose(tf(s)[1], plain(s)[1], atol=1e-14)
    assert np.isin(positions, tf.positions).all() and len(tf.positions) == 67


def test_bad_colormaps_are_refused():
    with pytest.raises(ValueError, match="no colour map 'virids'. Did you mean viridis"):
        TransferFunction.from_colormap("virids", P, E)
    for bad in ([[1, 2]], lambda x: x, [["a", "b", "c"]], None):
        with pytest.raises(ValueError, match="colour"):
            TransferFunction.from_colormap(bad, P, E)
    with pytest.raises(ValueError, match="positions must not decrease"):
        TransferFunction.from_colormap("viridis", P[::-1], E)
    with pytest.raises(ValueError, match="at least one"):
        TransferFunction.from_colormap("viridis", [], [])
    with pytest.raises(ValueError, match="outside jit"):
        jax.jit(lambda p: TransferFunction.from_colormap("viridis", p, E))(P)


def test_opacities_in_both_conventions(dtype):
    opacities = np.array([0.0, 0.5, 0.25, 0.875], dtype)
    loose = TransferFunction.from_opacity(P, C, opacities, 0.5, "unstructured", dtype=dtype)
    np.testing.assert_allclose(loose.extinctions, opacities / 0.5)
    grid = TransferFunction.from_opacity(P, C, opacities, 2.0, "grid", dtype=dtype)
    np.testing.assert_allclose(grid.extinctions, -np.log(1 - opacities) / 2.0, rtol=1e-6)
    # VTK's two answers for an opacity of 0.5 over one unit of length: 0.393 and 0.5.
    for convention, alpha in (("unstructured", 0.39347), ("grid", 0.5)):
        tf = TransferFunction.from_opacity([0.0], [[1, 1, 1]], [0.5], 1.0, convention)
        assert 1 - np.exp(-float(tf.extinctions[0])) == pytest.approx(alpha, abs=1e-5)
        np.testing.assert_allclose(tf.to_opacity(1.0, convention), [0.5])
    np.testing.assert_allclose(grid.to_opacity(2.0, "grid"), opacities, rtol=1e-6)
    assert TransferFunction.from_opacity(P, "viridis", E / 7).colors.shape == (4, 3)


def test_opacity_one_on_a_grid_needs_a_bound():
    opacities = [0.0, 1.0, 1.0, 0.5]
    with pytest.raises(ValueError, match=r"opacities\[1\] is 1.*infinite"):
        TransferFunction.from_opacity(P, C, opacities, 1.0, "grid")
    tf = TransferFunction.from_opacity(P, C, opacities, 1.0, "grid", max_opacity=0.999)
    np.testing.assert_allclose(tf.extinctions, [0, np.log(1000), np.log(1000), np.log(2)])


@pytest.mark.parametrize(
    "arguments, message",
    [
        (([0.0, 1.5, 0, 0],), r"opacities\[1\] is 1.5"),
        (([0.0, -0.5, 0, 0],), r"opacities\[1\] is -0.5"),
        (([0.0, np.nan, 0, 0],), "opacities has 1 NaN"),
        ((E / 7, 0.0), "unit_distance must be a length above 0"),
        ((E / 7, np.nan), "unit_distance"),
        ((E / 7, 1.0, "vtk"), "'unstructured' or 'grid', but is 'vtk'"),
    ],
)
def test_bad_opacities_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        TransferFunction.from_opacity(P, C, *arguments)


def test_resampling_keeps_the_function_where_it_can(dtype):
    tf = make(dtype, JUMP)
    finer = tf.resample([-1.0, 0.0, 0.25, 1.0, 1.0, 1.5, 2.0, 3.0])
    s = np.linspace(-2, 4, 121).astype(dtype)
    for a, b in zip(tf(s), finer(s), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5 if dtype == "float32" else 1e-14)
    assert finer.dtype == dtype
    even = make(dtype).with_points(7)
    np.testing.assert_allclose(even.positions, np.linspace(-1, 2, 7), atol=1e-6)
    np.testing.assert_allclose(even.extinctions, np.interp(np.linspace(-1, 2, 7), P, E), atol=1e-5)
    with pytest.raises(ValueError, match="n >= 2"):
        even.with_points(1)
    with pytest.raises(ValueError, match="at least one position"):
        tf.resample([])


def test_scaled_and_replace():
    np.testing.assert_allclose(make().scaled(2.5).extinctions, 2.5 * E)
    np.testing.assert_array_equal(make().replace(colors=C * 0).colors, 0)
    with pytest.raises(ValueError, match="negative"):
        make().scaled(-1.0)
    with pytest.raises(ValueError, match=r"has no \['opacity'\]"):
        make().replace(opacity=E)
