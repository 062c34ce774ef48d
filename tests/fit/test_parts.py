"""The parts of a fit that need no renderer: losses, transforms, batches, checkpoints."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxvr.fit import Ordered, Parameters, Sigmoid, Softplus, l1, l2, noise, smoothness
from jaxvr.fit import checkpoint as files
from jaxvr.fit.batches import Views, deal
from jaxvr.fit.loop import batch_number, is_stale
from jaxvr.optics import TransferFunction


def tf_of(dtype="float64"):
    return TransferFunction(
        [0.0, 0.25, 1.0], [[0, 0.5, 1], [1, 0, 0.2], [0.3, 0.3, 0.3]], [0.0, 2.0, 7.0], dtype=dtype
    )


def test_losses():
    a, b = jnp.array([[1.0, 2.0]]), jnp.array([[0.0, 4.0]])
    assert float(l1(a, b)) == 1.5 and float(l2(a, b)) == 2.5
    assert float(smoothness(jnp.array([0.0, 1.0, 3.0]))) == 2.5
    assert float(smoothness(jnp.ones((1, 3)))) == 0


def test_transforms_invert_and_stay_finite_on_the_border(dtype):
    for transform, values in (
        (Sigmoid(), [0.0, 1e-3, 0.5, 0.9, 1.0]),
        (Sigmoid(-1.0, 3.0), [-1.0, 0.0, 3.0]),
        (Softplus(), [0.0, 1e-3, 1.0, 50.0, 1e4]),
        (Softplus(0.01), [0.0, 1e-3, 1.0]),
        (Ordered(0.0, 2.0), [0.0, 0.5, 0.5, 1.0, 2.0]),
    ):
        x = jnp.asarray(values, dtype)
        raw = transform.to_raw(x)
        assert raw.dtype == x.dtype and bool(jnp.isfinite(raw).all())
        scale = float(x.max() - x.min())
        if isinstance(transform, Softplus):
            scale = transform.unit
        back = transform.to_value(raw)
        gap = np.abs(np.asarray(back - x))
        assert (gap <= 1.1e-4 * scale + 1e-5 * np.abs(x)).all(), (transform, gap)
        inside = (x > x.min()) & (x < x.max())
        assert np.allclose(back[inside], x[inside], rtol=1e-4)


@pytest.mark.parametrize("raw", [-1e4, -30.0, 0.0, 30.0, 1e4])
def test_any_raw_number_is_allowed(raw, dtype):
    x = jnp.full(4, raw, dtype)
    assert ((Sigmoid().to_value(x) >= 0) & (Sigmoid().to_value(x) <= 1)).all()
    assert (Softplus().to_value(x) >= 0).all() and jnp.isfinite(Softplus().to_value(x)).all()
    p = Ordered(1.0, 2.0).to_value(x.at[0].set(-raw))
    assert (jnp.diff(p) > 0).all() and float(p[0]) == 1 and float(p[-1]) == 2


def test_parameters_move_only_what_is_free():
    tf = tf_of()
    parameters = Parameters.of(tf, ("extinctions", "positions"))
    raw = parameters.raw()
    assert raw["extinctions"].shape == (3,) and raw["positions"].shape == (2,)
    back = parameters.transfer_of(jax.tree.map(lambda x: x + 0.5, raw))
    assert (back.colors == tf.colors).all() and not jnp.allclose(back.extinctions, tf.extinctions)
    np.testing.assert_allclose(back.positions, tf.positions, atol=1e-12)


@pytest.mark.parametrize(
    ("free", "message"),
    [(("color",), "free names"), ((), "free is empty")],
)
def test_bad_free(free, message):
    with pytest.raises(ValueError, match=message):
        Parameters.of(tf_of(), free)


def test_colors_out_of_range_ask_for_bounds():
    tf = tf_of().replace(colors=2 * tf_of().colors)
    with pytest.raises(ValueError, match="do not fit between 0 and 1"):
        Parameters.of(tf)
    raw = Parameters.of(tf, {"colors": Sigmoid(0.0, 4.0)}).raw()
    assert bool(jnp.isfinite(raw["colors"]).all())


def test_noise_is_a_function_of_the_seed(dtype):
    x = np.linspace(0, 1, 9, dtype=dtype)
    a, b, c = noise(x, 3.0, 1), noise(x, 3.0, 1), noise(x, 3.0, 2)
    assert a.dtype == dtype and (a.colors == b.colors).all() and (a.colors != c.colors).any()


def views_of(shapes):
    n = sum(h * w for h, w in shapes)
    return Views(shapes, np.zeros((n, 4)), None, np.zeros(n, int), np.zeros(n, int))


def test_batches_have_one_size_and_hold_every_ray():
    views = views_of([(5, 4), (3, 7)])
    dealt = deal(views, 9, None, 0)
    assert {len(p) for p in dealt} == {9} and len(dealt) == 5
    assert set(np.concatenate(dealt)) == set(range(41))
    assert [list(p) for p in dealt] == [list(p) for p in deal(views, 9, None, 0)]
    assert len(deal(views, 10**9, None, 0)[0]) == 41
    whole = deal(views_of([(2, 3)] * 3), None, 2, 0)
    assert len(whole) == 2 and all(len(p) == 12 for p in whole)
    for arguments, message in (
        ((9, 1), "not both"),
        ((0, None), "at least 1"),
        ((None, 1), "one size"),
    ):
        with pytest.raises(ValueError, match=message):
            deal(views, *arguments, 0)


def test_an_epoch_takes_every_batch_once():
    for epoch in range(3):
        numbers = [batch_number(5 * epoch + k, 5, 7) for k in range(5)]
        assert sorted(numbers) == list(range(5))


def test_stale():
    falling = [1.0 / (k + 1) for k in range(20)]
    assert not is_stale(falling, 1, 5, 1e-3)
    assert is_stale(falling + [1.0] * 5, 1, 5, 1e-3)
    assert not is_stale(falling + [1.0] * 4, 1, 5, 1e-3)
    assert not is_stale([1.0] * 50, 1, None, 1e-3)
    # noise between batches is no stagnation of the epoch's mean
    assert not is_stale([x for k in range(20) for x in (2 - 0.1 * k, 0.1)], 2, 5, 1e-3)


def test_checkpoint_round_trip_and_strangers(tmp_path):
    path = tmp_path / "deep" / "c.npz"
    state = {"a": jnp.arange(3.0), "n": jnp.int32(4), "k": jnp.float32(1e-40)}
    files.save(path, state, [1.0, 0.5], {"seed": 1})
    back, losses = files.load(path, state, {"seed": 1})
    assert losses == [1.0, 0.5] and [p.name for p in path.parent.iterdir()] == ["c.npz"]
    for x, y in zip(jax.tree.leaves(state), jax.tree.leaves(back), strict=True):
        assert x.dtype == y.dtype and np.asarray(x).tobytes() == np.asarray(y).tobytes()
    with pytest.raises(ValueError, match="seed was 1 and is 2"):
        files.load(path, state, {"seed": 2})
    with pytest.raises(ValueError, match="an array was"):
        files.load(path, state | {"a": jnp.zeros(4)}, {"seed": 1})
    with pytest.raises(ValueError, match="other"):
        files.load(path, {"a": jnp.zeros(3)}, {"seed": 1})
    for bad in (b"", b"nonsense", path.read_bytes()[:100]):
        (tmp_path / "bad.npz").write_bytes(bad)
        with pytest.raises(ValueError, match="no checkpoint"):
            files.load(tmp_path / "bad.npz", state, {})
