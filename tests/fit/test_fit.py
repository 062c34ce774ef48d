"""`fit` on a small mesh: recovery, determinism, resume, stops, bad input."""

from __future__ import annotations

import json

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxvr
from jaxvr.fit import fit as module_fit
from jaxvr.fit import noise
from jaxvr.fit.fit import _gradient

SIZE = 12


class Scene:
    """Three views of a box, by a transfer function with eight control points."""

    def __init__(self):
        self.volume = jaxvr.datasets.box((2, 2, 2), jitter=0.2, dtype="float64")
        values = np.asarray(self.volume.values)
        x = np.linspace(values.min(), values.max(), 8)
        self.tf = jaxvr.TransferFunction.from_colormap(
            "turbo", x, [0, 1, 4, 1, 6, 0.5, 8, 2], dtype="float64"
        )
        self.cameras = jaxvr.Camera.sphere(self.volume, 3, width=SIZE, height=SIZE)
        self.segments = [jaxvr.trace(self.volume, c) for c in self.cameras]
        self.held = jaxvr.Camera.orbit(self.volume, width=SIZE, height=SIZE)
        self.targets = [np.asarray(jaxvr.render(self.volume, c, self.tf)) for c in self.cameras]
        self.unseen = np.asarray(jaxvr.render(self.volume, self.held, self.tf))
        self.held_segments = jaxvr.trace(self.volume, self.held)
        self.start = noise(self.tf.positions, 2.0, seed=1)

    def fit(self, **keywords):
        keywords = {"learning_rate": 0.2, "rays": 200} | keywords
        return jaxvr.fit(self.start, self.volume, self.segments, self.targets, **keywords)


@pytest.fixture(scope="module")
def scene():
    return Scene()


def same(a, b):
    for name in ("positions", "colors", "extinctions"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@pytest.mark.parametrize("kind", ["float32", "float64"])
def test_recovers_the_transfer_function(kind, scene, tmp_path):
    def cast(x):
        return x.astype(kind) if jnp.issubdtype(x.dtype, jnp.floating) else x

    segments, unseen = jax.tree.map(cast, (scene.segments, scene.held_segments))
    rate = optax.cosine_decay_schedule(0.3, 300)
    result = jaxvr.fit(
        scene.start,
        None,
        segments,
        scene.targets,
        iterations=300,
        rays=200,
        optimizer=optax.adam(rate, b2=0.95),
        held_out=(unseen, scene.unseen),
    )
    report = result.report()
    assert report["held_out"][0]["psnr"] > 50 and report["held_out"][0]["ssim"] > 0.999
    assert result.transfer.dtype == kind and result.images[0].dtype == kind
    assert result.loss_history.shape == (300,) and report["rays_per_iteration"] == 200
    np.testing.assert_allclose(
        result.transfer.extinctions[1:-1], scene.tf.extinctions[1:-1], atol=0.1
    )
    # the pictures are those of the fitted function, pixel by pixel
    again = jaxvr.render(scene.volume, scene.cameras[1], result.transfer)
    np.testing.assert_allclose(result.images[1], again, atol=1e-5 if kind == "float32" else 1e-12)
    folder = result.save(tmp_path / "out")
    assert json.loads((folder / "report.json").read_text()) == report
    same(jaxvr.TransferFunction.from_json(folder / "transfer.json", dtype=kind), result.transfer)
    assert set(np.load(folder / "images.npz")) == {"view0", "view1", "view2", "held_out0"}


def test_module_and_name_are_one():
    assert module_fit is jaxvr.fit


def test_nothing_is_compiled_twice(scene):
    size = getattr(_gradient, "_cache_size")  # noqa: B009 (JAX's types do not show it)
    scene.fit(iterations=1)
    before = size()
    scene.fit(iterations=6, seed=5)
    assert size() == before


def test_resume_goes_on_to_the_bit(scene, tmp_path):
    whole = scene.fit(iterations=10)
    path = tmp_path / "fit.npz"
    scene.fit(iterations=5, checkpoint=path)
    rest = scene.fit(iterations=10, checkpoint=path, resume=True)
    np.testing.assert_array_equal(whole.loss_history, rest.loss_history)
    same(whole.transfer, rest.transfer)
    with pytest.raises(ValueError, match="rays was 200 and is 201"):
        scene.fit(iterations=10, checkpoint=path, resume=True, rays=201)


def test_the_seed_decides(scene):
    a, b, c = (scene.fit(iterations=4, seed=s) for s in (1, 1, 2))
    same(a.transfer, b.transfer)
    assert (a.loss_history != c.loss_history).any()


def test_cached_and_rendered_agree(scene):
    """All rays in a batch: the loss of iteration 0 is that of the whole pictures either way."""
    keywords = {"iterations": 2, "loss": "l2", "rays": None, "smoothness": 0.4}
    a = scene.fit(**keywords)
    b = jaxvr.fit(
        *(scene.start, scene.volume, scene.cameras, scene.targets),
        learning_rate=0.2,
        cache=False,
        **keywords,
    )
    np.testing.assert_allclose(a.loss_history, b.loss_history, rtol=1e-10)
    np.testing.assert_allclose(a.images[2], b.images[2], atol=1e-10)
    first = [jaxvr.render(scene.volume, c, scene.start) for c in scene.cameras]
    error = jnp.mean((jnp.stack(first) - jnp.stack(scene.targets)) ** 2)
    prior = jnp.mean(jnp.diff(scene.start.colors, axis=0) ** 2)
    # colours and extinctions of the start are kept 1e-4 away from the border
    np.testing.assert_allclose(a.loss_history[0], error + 0.4 * prior, rtol=1e-6)


def test_whole_views_positions_background_and_schedules(scene):
    """RGB targets on a background, views of two sizes would need rays; positions stay sorted."""
    grey = np.array([0.2, 0.3, 0.4])
    targets = [t[..., :3] + (1 - t[..., 3:]) * grey for t in scene.targets]
    result = jaxvr.fit(
        scene.start,
        None,
        scene.segments,
        targets,
        views=2,
        iterations=4,
        background=grey,
        free=("colors", "extinctions", "positions"),
        smoothness=lambda i: 0.1 / (i + 1),
        smoothness_extinctions=0.01,
        loss=lambda a, b: jnp.mean((a - b) ** 2),
    )
    assert result.report()["rays_per_iteration"] == 2 * SIZE * SIZE
    positions = np.asarray(result.transfer.positions)
    assert (np.diff(positions) > 0).all() and (positions != scene.start.positions).any()
    assert result.images[0].shape == (SIZE, SIZE, 4)
    np.testing.assert_allclose(result.images[0][0, 0], [*grey, 1], atol=1e-12)


def test_callback_and_patience(scene):
    seen = []

    def callback(iteration, loss, transfer):
        seen.append(transfer.extinctions)
        return len(seen) == 3

    result = scene.fit(iterations=50, callback=callback)
    assert result.stopped == "callback" and len(result.loss_history) == 3
    np.testing.assert_array_equal(seen[-1], result.transfer.extinctions)
    slow = scene.fit(iterations=50, learning_rate=1e-9, patience=5)
    assert slow.stopped == "patience" and len(slow.loss_history) < 20


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"targets": lambda s: s.targets[:2]}, "3 cameras, but 2 targets"),
        ({"targets": lambda s: [t[:-1] for t in s.targets]}, r"targets\[0\] must have shape \(12"),
        ({"targets": lambda s: [t[..., 0] for t in s.targets]}, r"targets\[0\] must have shape"),
        ({"targets": lambda s: [t[..., :3] for t in s.targets]}, "need background="),
        ({"targets": lambda s: [t * np.nan for t in s.targets]}, "NaN or infinite"),
        ({"targets": lambda s: 3}, "targets must be images"),
        ({"cameras": lambda s: []}, "cameras is empty"),
        ({"cameras": lambda s: [1, 2, 3]}, r"cameras\[0\] must be a jaxvr.Camera"),
        ({"volume": lambda s: None}, "volume is None"),
        ({"transfer": lambda s: 1}, "transfer must be"),
    ],
)
def test_bad_operands(scene, change, message):
    operands = {name: getattr(scene, name) for name in ("volume", "cameras", "targets")}
    operands = {"transfer": scene.start} | operands
    operands |= {name: make(scene) for name, make in change.items()}
    with pytest.raises(ValueError, match=message):
        jaxvr.fit(**operands, iterations=1)


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"loss": "huber"}, "loss must be one of"),
        ({"smoothness": -1}, "smoothness must be"),
        ({"free": "color"}, "free names"),
        ({"rays": 5, "views": 1}, "not both"),
        ({"rays": -5}, "rays must be"),
        ({"held_out": 3}, "held_out must be"),
        ({"background": [1, 2]}, "background must be RGB with shape"),
        ({"cache": False}, "some of the cameras are Segments"),
        ({"iterations": 0}, "iterations must be"),
    ],
)
def test_bad_keywords(scene, keywords, message):
    with pytest.raises(ValueError, match=message):
        scene.fit(**({"iterations": 1} | keywords))


def test_fits_through_a_pre_integrated_table(scene):
    """The transfer function is fitted through the making of the table; judged by `Analytic`."""
    table = jaxvr.PreIntegration((48, 48, 12), schedule="one by one")
    result = scene.fit(iterations=60, rays=None, integrator=table)
    assert result.loss_history[-1] < 0.02 * result.loss_history[0]
    image = jaxvr.shade(scene.held_segments, result.transfer)
    assert jaxvr.psnr(np.asarray(image), scene.unseen) > 25
