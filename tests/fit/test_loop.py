"""`fit_parameters`: any loss over any parameters."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxvr
from jaxvr.fit import FitError, fit_parameters

TARGET = jnp.array([1.0, -2.0, 0.5])


def distance(p):
    return jnp.sum((p["x"] - TARGET) ** 2)


START = {"x": jnp.zeros(3)}


def test_finds_the_minimum_and_compiles_once():
    traced = []

    def loss(p):
        traced.append(1)
        return distance(p)

    result = fit_parameters(loss, START, learning_rate=0.2, iterations=200)
    np.testing.assert_allclose(result.parameters["x"], TARGET, atol=1e-3)
    assert len(traced) == 1 and result.loss_history.shape == (200,)
    assert result.loss_history[0] == pytest.approx(5.25) and result.stopped == "iterations"


def test_any_optimizer():
    result = fit_parameters(distance, START, optimizer=optax.sgd(0.25), iterations=30)
    np.testing.assert_allclose(result.parameters["x"], TARGET, atol=1e-6)


def test_callback_stops():
    seen = []

    def callback(iteration, loss, parameters):
        seen.append((iteration, loss, float(parameters["x"][0])))
        return iteration == 3

    result = fit_parameters(distance, START, iterations=50, callback=callback)
    assert [s[0] for s in seen] == [0, 1, 2, 3] and result.stopped == "callback"
    assert seen[0][1] == 5.25 and seen[0][2] > 0


def test_patience_stops():
    result = fit_parameters(distance, START, learning_rate=0.2, iterations=5000, patience=20)
    assert result.stopped == "patience" and 20 < len(result.loss_history) < 1000


def test_batches_and_resume_to_the_bit(tmp_path):
    batches = [jnp.full(3, float(k)) for k in range(3)]

    def loss(p, batch):
        return jnp.sum(jnp.abs(p["x"] - batch) ** 1.5)

    keywords: dict[str, Any] = {"batches": batches, "seed": 3, "checkpoint_every": 4}
    whole = fit_parameters(loss, START, iterations=10, **keywords)
    path = tmp_path / "c.npz"
    fit_parameters(loss, START, iterations=5, checkpoint=path, **keywords)
    rest = fit_parameters(loss, START, iterations=10, checkpoint=path, resume=True, **keywords)
    assert len(rest.seconds) == 5
    np.testing.assert_array_equal(whole.parameters["x"], rest.parameters["x"])
    np.testing.assert_array_equal(whole.loss_history, rest.loss_history)
    again = fit_parameters(loss, START, iterations=10, checkpoint=path, resume=True, **keywords)
    assert len(again.seconds) == 0
    np.testing.assert_array_equal(whole.parameters["x"], again.parameters["x"])
    keywords["seed"] = 4
    with pytest.raises(ValueError, match="seed was 3 and is 4"):
        fit_parameters(loss, START, checkpoint=path, resume=True, **keywords)


def test_not_finite_names_the_iteration():
    def loss(p):
        return jnp.log(p["x"][0])

    with pytest.raises(FitError, match="At iteration 3 the loss is nan .it was -"):
        fit_parameters(loss, {"x": jnp.array([1.5])}, optimizer=optax.sgd(0.6), iterations=9)
    with pytest.raises(FitError, match="At iteration 0 the gradient has NaN"):
        fit_parameters(lambda p: jnp.sqrt(p), jnp.zeros(()), iterations=9)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"iterations": 0}, "iterations must be"),
        ({"iterations": 2.5}, "iterations must be"),
        ({"patience": -1}, "patience must be"),
        ({"tolerance": 2}, "tolerance must lie"),
        ({"learning_rate": -1}, "learning_rate must be"),
        ({"optimizer": "adam"}, "optax GradientTransformation"),
        ({"resume": True}, "needs checkpoint"),
        ({"batches": []}, "batches is empty"),
    ],
)
def test_bad_arguments(keywords, message):
    with pytest.raises(ValueError, match=message):
        fit_parameters(distance, START, **keywords)
    with pytest.raises(ValueError, match="float arrays"):
        fit_parameters(distance, {"x": jnp.arange(3)})


def test_progress_is_silent_where_there_is_no_terminal(capsys):
    fit_parameters(distance, START, iterations=2)
    assert capsys.readouterr().err == ""
    fit_parameters(distance, START, iterations=2, progress=True)
    assert "2/2" in capsys.readouterr().err


def test_fits_the_values_of_a_mesh():
    volume = jaxvr.datasets.box((1, 1, 1), dtype="float64")
    tf = jaxvr.TransferFunction([0.0, 1.0], [[1, 0, 0], [0, 0, 1]], [1.0, 3.0])
    camera = jaxvr.Camera.orbit(volume, width=8, height=8)
    target = jaxvr.render(volume, camera, tf)

    def loss(values):
        return jnp.mean((jaxvr.render(volume.replace(values=values), camera, tf) - target) ** 2)

    start = jnp.full_like(volume.values, 0.4)
    result = fit_parameters(loss, start, learning_rate=0.05, iterations=60)
    assert result.loss_history[-1] < 1e-2 * result.loss_history[0]
    assert jax.tree.leaves(result.parameters)[0].shape == volume.values.shape
