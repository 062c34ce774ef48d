"""Checkpoints: a resumed fit is the unbroken one to the bit, and no other fit is taken for it."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
import zipfile
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import jaxvr
from jaxvr._core import writing
from jaxvr._core.writing import require_place, whole_file
from jaxvr.fit import CheckpointWarning, Ordered, Sigmoid, Softplus, fit_parameters
from jaxvr.fit import checkpoint as files
from jaxvr.fit.resume import Keeper

SIZE = 6
RATE = optax.cosine_decay_schedule(0.2, 9)


def scene(**changes: Any) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Operands and keywords of a small fit, some of them others."""
    field = changes.pop("field", lambda p: p[:, 0] + 0.2 * p[:, 1])
    dtype = changes.pop("dtype", "float64")
    volume = jaxvr.datasets.box((1, 1, 1), field=field, dtype=dtype)
    if "move" in changes:
        volume = volume.replace(points=np.asarray(volume.points) * changes.pop("move"))
    cameras = jaxvr.Camera.sphere(volume, 2, width=SIZE, height=SIZE)
    if "turn" in changes:
        cameras[1] = jaxvr.Camera.orbit(volume, changes.pop("turn"), width=SIZE, height=SIZE)
    x = np.linspace(0, 1.2, 4)
    start = jaxvr.TransferFunction(x, np.full((4, 3), 0.4), np.full(4, 2.0), dtype=dtype)
    if "start" in changes:
        start = start.replace(extinctions=start.extinctions + changes.pop("start"))
    rng = np.random.default_rng(changes.pop("target", 0))
    alpha = 0.5 * rng.random((SIZE, SIZE, 1))
    targets = [np.concatenate([alpha * rng.random((SIZE, SIZE, 3)), alpha], -1) for _ in range(2)]
    if changes.get("background") is not None:
        targets = [t[..., :3] for t in targets]
    keywords = {"rays": 20, "learning_rate": RATE, "progress": False}
    return (start, volume, cameras, targets), keywords | changes


def fit(**changes: Any) -> Any:
    operands, keywords = scene(**changes)
    return jaxvr.fit(*operands, **keywords)


def same(a: Any, b: Any) -> None:
    np.testing.assert_array_equal(a.loss_history, b.loss_history)
    for x, y in zip(jax.tree.leaves(a.transfer), jax.tree.leaves(b.transfer), strict=True):
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


FREE = {
    "colors": Sigmoid(-0.5, 1.5),
    "extinctions": Softplus(2.0),
    "positions": Ordered(0.0, 1.2),
}


@pytest.mark.parametrize(
    "more",
    [
        {"smoothness": lambda i: 0.1 / (i + 1)},
        {
            "dtype": "float32",
            "free": FREE,
            "optimizer": optax.chain(optax.clip(0.3), optax.add_noise(0.1, 0.5, 3)),
        },
    ],
    ids=["schedules", "transforms"],
)
def test_resumed_at_any_iteration(more, tmp_path):
    whole = fit(iterations=5, **more)
    path = tmp_path / "c.npz"
    for done in (1, 3):
        fit(iterations=done, checkpoint=path, **more)
        same(whole, fit(iterations=5, checkpoint=path, resume=True, **more))


def test_resumed_in_another_process(tmp_path):
    code = (
        "import sys, jax; jax.config.update('jax_enable_x64', True)\n"
        "sys.path.insert(0, 'tests/fit')\n"
        "import test_resume as t\n"
        f"t.fit(iterations=3, checkpoint={str(tmp_path / 'c.npz')!r}, resume=True)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=300)
    whole, path = fit(iterations=6), tmp_path / "c.npz"
    same(whole, fit(iterations=6, checkpoint=path, resume=True))


def l1(a, b):
    return jnp.mean(jnp.abs(a - b))


OTHERS = {
    "values": ({"field": lambda p: p[:, 0] - p[:, 2]}, "volume.values are others"),
    "points": ({"move": 1.01}, "volume.points are others"),
    "camera": ({"turn": 31.0}, r"1 of 2 cameras are others, the first is cameras\[1\]"),
    "targets": ({"target": 1}, r"2 of 2 targets are others, the first is targets\[0\]"),
    "start": ({"start": 0.1}, "the start is another"),
    "free": ({"free": "colors"}, r"free was \['colors', 'extinctions'\] and is \['colors'\]"),
    "transforms": (
        {"free": {"colors": Sigmoid(0.0, 1.1), "extinctions": Softplus(2.0)}},
        "transforms are others",
    ),
    "loss": ({"loss": "l2"}, "loss was 'l1' and is 'l2'"),
    "loss of the same name": (
        {"loss": lambda a, b: jnp.mean(jnp.abs(a - b)) * 2, "was": {"loss": lambda a, b: l1(a, b)}},
        "loss is another",
    ),
    "rate": (
        {"learning_rate": optax.cosine_decay_schedule(0.3, 9)},
        "the optimiser is another",
    ),
    "constant rate": ({"learning_rate": 0.2}, "the optimiser or the free parameters are others"),
    "decay": (
        {"learning_rate": optax.cosine_decay_schedule(0.2, 10)},
        "the optimiser is another",
    ),
    "moments": ({"optimizer": optax.adam(RATE, b1=0.8)}, "the optimiser is another"),
    "optimiser": ({"optimizer": optax.sgd(0.1)}, "the optimiser or the free parameters are others"),
    "smoothness": ({"smoothness": 0.1}, "smoothness in the iterations made is another"),
    "background": ({"background": (1.0, 1.0, 1.0)}, "background is another"),
    "integrator": (
        {"integrator": jaxvr.AverageColor()},
        r"integrator was .Analytic.* and is .AverageColor",
    ),
    "compositor": ({"compositor": jaxvr.Over(0.01)}, "compositor was .Over"),
    "adjoint": ({"adjoint": jaxvr.Direct(50)}, "adjoint was .Replay"),
    "engine": ({"engine": jaxvr.engine.XLA()}, "engine was .None. and is .XLA"),
    "seed": ({"seed": 1}, "seed was 0 and is 1"),
    "rays": ({"rays": 21}, "rays was 20 and is 21"),
    "cache": ({"cache": False}, "cache was True and is False"),
    "dtype": ({"dtype": "float32"}, "dtype was 'float64' and is 'float32'"),
}


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    path = tmp_path_factory.mktemp("fit") / "c.npz"
    fit(iterations=2, checkpoint=path)
    return path


@pytest.mark.parametrize("kind", OTHERS)
def test_another_fit_is_refused(kind, stored, tmp_path):
    changes, message = OTHERS[kind]
    changes, path = dict(changes), stored
    if was := changes.pop("was", None):
        path = tmp_path / "c.npz"
        fit(iterations=1, checkpoint=path, **was)
    before = path.read_bytes()
    with pytest.raises(ValueError, match=f"belongs to another fit: .*{message}"):
        fit(iterations=4, checkpoint=path, resume=True, **changes)
    assert path.read_bytes() == before and os.listdir(path.parent) == [path.name]


TARGET = jnp.array([1.0, -2.0, 0.5])
START = {"x": jnp.zeros(3)}


def toward(target):
    return lambda p: jnp.sum((p["x"] - target) ** 2)


def test_arrays_that_a_loss_closes_over_belong_to_it(tmp_path):
    path = tmp_path / "c.npz"
    whole = fit_parameters(toward(TARGET), START, iterations=6)
    fit_parameters(toward(TARGET), START, iterations=3, checkpoint=path)
    again = {"iterations": 6, "checkpoint": path, "resume": True}
    for loss in (toward(TARGET + 1e-6), lambda p: 2 * toward(TARGET)(p)):
        with pytest.raises(ValueError, match="the program of the loss is another"):
            fit_parameters(loss, START, **again)
    with pytest.raises(ValueError, match="parameters are others"):
        fit_parameters(toward(TARGET), {"x": jnp.ones(3)}, **again)
    rest = fit_parameters(toward(TARGET), START, **again)
    np.testing.assert_array_equal(whole.parameters["x"], rest.parameters["x"])
    with pytest.raises(ValueError, match="belongs to another fit: verb was 'fit_parameters'"):
        fit(iterations=2, checkpoint=path, resume=True)


def test_the_loss_is_traced_once_with_a_checkpoint_too(tmp_path):
    traced = []

    def loss(p):
        traced.append(1)
        return toward(TARGET)(p)

    fit_parameters(loss, START, iterations=4, checkpoint=tmp_path / "c.npz", checkpoint_every=1)
    assert len(traced) == 1


def test_more_iterations_than_asked_for_are_told(tmp_path):
    path = tmp_path / "c.npz"
    fit_parameters(toward(TARGET), START, iterations=8, checkpoint=path)
    with pytest.warns(CheckpointWarning, match="holds 8 iterations, more than the 3") as caught:
        got = fit_parameters(toward(TARGET), START, iterations=3, checkpoint=path, resume=True)
    assert len(got.loss_history) == 8 and caught[0].filename == __file__


def test_other_versions_are_told(tmp_path):
    path = tmp_path / "c.npz"
    state = {"x": jnp.zeros(3)}
    files.save(
        path, state, [1.0], {"seed": 1, "environment": {"jax": "0.1"}, "programs": {"a": "b"}}
    )
    now = {"seed": 1, "environment": {"jax": "0.2"}, "programs": {"a": "c"}}
    with pytest.warns(CheckpointWarning, match=r"jax was 0.1 and is 0.2.*taken to be the same: a"):
        files.load(path, state, now)
    with pytest.raises(ValueError, match="seed was 1 and is 2"):
        files.load(path, state, now | {"seed": 2})


def test_leaves_of_any_dtype_come_back_as_they_were(tmp_path):
    state = {
        "half": jnp.arange(3, dtype=jnp.bfloat16),
        "key": jax.random.key(3),
        "weak": jnp.asarray(0.5) + 1.0,
        "tiny": jnp.asarray([5e-324, np.inf, -0.0]),
        "none": jnp.zeros((0, 4)),
        "bits": jnp.asarray([True, False]),
    }
    files.save(tmp_path / "c.npz", state, [], {})
    back, losses = files.load(tmp_path / "c.npz", state, {})
    assert losses == [] and jax.tree.structure(back) == jax.tree.structure(state)
    for name, x in state.items():
        assert back[name].aval == x.aval, name
        assert writing_bits(back[name]) == writing_bits(x), name


def writing_bits(x):
    return files.raw(x).tobytes()


def whole_state():
    return {"a": jnp.arange(12.0).reshape(4, 3)}, (jnp.int32(7),)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    path = tmp_path_factory.mktemp("sound") / "c.npz"
    files.save(path, whole_state(), [1.0, 0.5], {"seed": 1})
    return path.read_bytes()


def rebuilt(data: bytes, changes: Any, **options: Any) -> bytes:
    """The archive with other parts: bytes, None to leave one out, or a function of what was."""
    import io

    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w", **options) as new:
        for name in old.namelist():
            change = changes.get(name, lambda was: was)
            made: Any = change(old.read(name)) if callable(change) else change
            if made is not None:
                new.writestr(name, made)
        for name in set(changes) - set(old.namelist()):
            new.writestr(name, changes[name])
    return out.getvalue()


def with_head(**changes: Any):
    return lambda was: json.dumps(json.loads(was) | changes)


GIANT = b"\x93NUMPY\x01\x00v\x00" + (
    b"{'descr': '<f8', 'fortran_order': False, 'shape': (1099511627776,), }".ljust(117) + b"\n"
)
PARTS = {
    "no settings": {"about.json": None},
    "settings no dict": {"about.json": b"[1]"},
    "settings no JSON": {"about.json": b"\xff\xfe"},
    "another format": {"about.json": with_head(format="jaxvr fit 9")},
    "no structure": {"about.json": with_head(structure=None)},
    "leaves no list": {"about.json": with_head(leaves=3)},
    "a leaf no list": {"about.json": with_head(leaves=["float32", 3])},
    "more losses": {"about.json": with_head(iterations=10**12)},
    "fewer losses": {"about.json": with_head(iterations=-1)},
    "a leaf is missing": {"leaf1.npy": None},
    "a leaf too many": {"leaf9.npy": b"x"},
    "losses of 8 TB": {"losses.npy": GIANT},
    "a leaf of 8 TB": {"leaf0.npy": GIANT},
    "a leaf of objects": {"leaf0.npy": lambda was: was.replace(b"'<f8'", b"'|O8'")},
    "a leaf of another shape": {"leaf0.npy": lambda was: was.replace(b"(4, 3)", b"(3, 4)")},
    "a leaf cut short": {"leaf0.npy": lambda was: was[:-1]},
    "a header alone": {"leaf0.npy": b"\x93NUMPY"},
    "an empty leaf": {"leaf1.npy": b""},
}


@pytest.mark.parametrize("kind", PARTS)
def test_parts_that_do_not_fit_make_no_checkpoint(kind, sound, tmp_path):
    path = tmp_path / "c.npz"
    path.write_bytes(rebuilt(sound, PARTS[kind]))
    with pytest.raises(ValueError, match=r"c.npz' is no checkpoint of a fit \(.+\). Delete it"):
        files.load(path, whole_state(), {"seed": 1})


def test_whatever_is_no_whole_file_gives_one_error(sound, tmp_path):
    """Files cut short anywhere, and with any bit turned over: the error, or all that was stored."""
    path = tmp_path / "c.npz"
    rng = np.random.default_rng(0)
    mutants = [sound[:n] for n in rng.integers(0, len(sound), 150)]
    for at in rng.integers(0, 8 * len(sound), 400):
        data = bytearray(sound)
        data[at // 8] ^= 1 << at % 8
        mutants.append(bytes(data))
    mutants += [rebuilt(sound, {}, compression=zipfile.ZIP_DEFLATED), b"", b"x" * 1000, sound * 2]
    errors = 0
    for data in mutants:
        path.write_bytes(data)
        try:
            state, losses = files.load(path, whole_state(), {"seed": 1})
        except ValueError as e:
            assert "c.npz' is no checkpoint of a fit (" in str(e)
            errors += 1
        else:
            assert losses == [1.0, 0.5]
            for a, b in zip(jax.tree.leaves(state), jax.tree.leaves(whole_state()), strict=True):
                np.testing.assert_array_equal(a, b)
    assert errors > 0.6 * len(mutants)


def test_folders_pipes_and_files_of_others(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for path, why in ((tmp_path, "it is a folder"), (tmp_path / "pipe", "it is no file")):
        with pytest.raises(ValueError, match=f"no checkpoint of a fit .{why}"):
            files.load(path, START, {})
    mine = tmp_path / "targets.npz"
    np.savez(mine, a=np.arange(3))
    before = mine.read_bytes()
    for resume in (False, True):
        with pytest.raises(ValueError, match="targets.npz' is no checkpoint of a fit"):
            fit_parameters(toward(TARGET), START, iterations=1, checkpoint=mine, resume=resume)
    assert mine.read_bytes() == before


PLACES = {
    "a folder": (lambda p: p, OSError, "it is a folder"),
    "below a file": (lambda p: p / "file" / "c.npz", OSError, "is no folder"),
    "a long name": (lambda p: p / ("x" * 5000), OSError, "File name too long"),
    "a null byte": (lambda p: f"{p}/a\0b", ValueError, "null"),
    "nothing": (lambda p: "", OSError, "it is a folder"),
    "a number": (lambda p: 3, ValueError, "not int"),
}


@pytest.mark.parametrize("kind", PLACES)
def test_the_place_is_tried_before_the_first_step(kind, tmp_path):
    make, error, reason = PLACES[kind]
    (tmp_path / "file").write_text("")
    seen = []
    with pytest.raises(
        error, match=f"(?s)The checkpoint cannot be written to .*{reason}"
    ) as caught:
        fit_parameters(
            lambda p: seen.append(1) or toward(TARGET)(p), START, checkpoint=make(tmp_path)
        )
    assert not seen and len(str(caught.value)) < 500
    assert os.listdir(tmp_path) == ["file"]


def test_a_place_that_cannot_be_written_is_found_before_tracing(tmp_path, monkeypatch):
    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="c.npz': No space left on device. Choose another place"):
        fit(iterations=1, checkpoint=tmp_path / "c.npz")
    assert os.listdir(tmp_path) == []


def test_a_failure_to_write_never_loses_the_result(tmp_path, monkeypatch):
    whole = fit_parameters(toward(TARGET), START, iterations=9)
    path, plain, calls = tmp_path / "c.npz", os.fsync, []

    def failing(handle):
        calls.append(1)
        if len(calls) > 3:  # the trial, the first checkpoint and its folder
            raise OSError(errno.ENOSPC, "No space left on device")
        plain(handle)

    monkeypatch.setattr(os, "fsync", failing)
    with pytest.warns(CheckpointWarning, match="No space left on device") as caught:
        result = fit_parameters(
            toward(TARGET), START, iterations=9, checkpoint=path, checkpoint_every=2
        )
    messages = [str(w.message) for w in caught]
    assert len(messages) == 2 and "after 4 iterations" in messages[0]
    assert "after 9 iterations" in messages[1] and "kept is after 2 iterations" in messages[1]
    np.testing.assert_array_equal(whole.parameters["x"], result.parameters["x"])
    assert os.listdir(tmp_path) == ["c.npz"]
    monkeypatch.undo()
    rest = fit_parameters(toward(TARGET), START, iterations=9, checkpoint=path, resume=True)
    assert len(rest.seconds) == 7
    np.testing.assert_array_equal(whole.parameters["x"], rest.parameters["x"])


def test_what_a_killed_writer_left_is_removed(tmp_path):
    path = tmp_path / "c.npz"
    ended = subprocess.Popen([sys.executable, "-I", "-S", "-c", ""])
    ended.wait()
    child = ended.pid
    mark = writing._mark(writing.place_of(path))
    left, alive = tmp_path / f"{mark}{child}-a.npz", tmp_path / f"{mark}{os.getppid()}-b.npz"
    other = tmp_path / f".jaxvr-000000000000-{child}-c.npz"
    for file in (left, alive, other):
        file.write_bytes(b"part")
    writing.require_place(path, "The checkpoint")
    kept = [alive, other] if os.name == "posix" else [left, alive, other]  # see `_sweep`
    assert sorted(tmp_path.iterdir()) == sorted(kept)


def test_links_stay_links_and_modes_stay(tmp_path):
    real = tmp_path / "disk" / "c.npz"
    files.save(real, START, [], {})
    real.chmod(0o640)
    link = tmp_path / "link.npz"
    link.symlink_to(real)
    files.save(link, START, [1.0], {})
    assert link.is_symlink() and files.load(real, START, {})[1] == [1.0]
    assert real.stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("seed", [1.5, -1, True, "a"])
def test_seeds_are_whole_numbers(seed):
    with pytest.raises(ValueError, match="seed must be a whole number of at least 0"):
        fit_parameters(toward(TARGET), START, seed=seed)
    with pytest.raises(ValueError, match="seed must be a whole number of at least 0"):
        fit(seed=seed)


def test_the_experiment_on_faults_finds_none():
    """In a process of its own, since it forks."""
    command = [sys.executable, "-m", "experiments.saved_faults", "--tiny"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "kills, checkpoints" in done.stdout and "fault" not in done.stdout


def test_a_fit_that_is_killed_and_resumed_is_the_unbroken_one():
    """In a process of its own, since it forks."""
    command = [sys.executable, "-m", "experiments.fit_kills", "--kills", "2"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    found = {what: int(n) for n, what in (line.split(None, 1) for line in done.stdout.splitlines())}
    assert found["resumed, equal to the bit"] == 1 and found["killed, with steps"] >= 1
    assert found["killed, with steps"] + found.get("killed, without a step", 0) == 2


def test_a_relative_path_stays_where_the_fit_began(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    keeper = Keeper("rel.npz", 1, lambda n: {})
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    keeper.step(START, [1.0])
    assert files.load(tmp_path / "rel.npz", START, {})[1] == [1.0]
    assert list((tmp_path / "elsewhere").iterdir()) == []


@pytest.mark.skipif(os.name != "posix", reason="POSIX modes")
def test_a_file_that_may_not_be_written_is_not_replaced(tmp_path, monkeypatch):
    place = tmp_path / "a.npz"
    place.write_bytes(b"kept")
    access = os.access  # root may write to anything
    monkeypatch.setattr(os, "access", lambda p, mode: access(p, mode) and mode != os.W_OK)
    with pytest.raises(PermissionError), whole_file(place) as file:
        file.write(b"new")
    with pytest.raises(PermissionError, match="checkpoint cannot be written to .*a.npz"):
        require_place(place, "The checkpoint")
    assert place.read_bytes() == b"kept" and list(tmp_path.iterdir()) == [place]
