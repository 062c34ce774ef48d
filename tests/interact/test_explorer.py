"""The explorer without a browser: what a hand does, what pictures come of it, what is answered."""

from __future__ import annotations

import io
import re
import sys
from typing import Any

import numpy as np
import pytest
from PIL import Image

import jaxvr
from jaxvr.interact import edits, viewer
from jaxvr.interact.orbit import Orbit
from jaxvr.interact.pace import DIVISORS, Pace
from jaxvr.interact.viewer import Viewer

pytestmark = pytest.mark.usefixtures("quick_code")
SIZE = 24
TRANSFER = jaxvr.TransferFunction([0.2, 0.5, 0.9], np.eye(3), [0.0, 4.0, 2.0], dtype="float32")


@pytest.fixture(scope="module")
def mesh():
    return jaxvr.datasets.box((2, 2, 2), dtype="float32")


@pytest.fixture
def view(mesh):
    return Viewer(mesh, TRANSFER, size=SIZE)


@pytest.fixture
def steady(mesh):
    """Whose coarse pictures do not depend on the processor."""
    return Viewer(mesh, TRANSFER, size=SIZE, coarse=8)


def pixels(data):
    return np.asarray(Image.open(io.BytesIO(data)))


# The view


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 1), (1, 0, 0), (0.3, -2, 0.5)])
@pytest.mark.parametrize("flat", [False, True])
def test_an_orbit_has_the_camera_it_was_made_from(up, flat):
    make = jaxvr.Camera.orthographic if flat else jaxvr.Camera.look_at
    camera = make((3.0, 1.0, -2.0), (0.1, 0.2, 0.3), up=up, width=20, height=10)
    again = Orbit.of(camera, 0.8).camera(20, 10, camera.dtype)
    for a, b in zip(camera.rays(), again.rays(), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_an_orbit_counts_as_camera_orbit_does(mesh):
    orbit = Orbit.of(jaxvr.Camera.orbit(mesh, 35.0, 25.0, zoom=1.5, dtype="float64"), 3**0.5 / 2)
    assert [orbit.azimuth, orbit.elevation, orbit.zoom] == pytest.approx([35, 25, 1.5], rel=1e-5)
    orbit = orbit.turned(200, 100).zoomed(0.5)
    assert (orbit.azimuth, orbit.elevation) == pytest.approx((-125, 89), rel=1e-5)
    want = jaxvr.Camera.orbit(mesh, -125, 89, zoom=0.75, dtype="float64")
    np.testing.assert_allclose(orbit.camera(8, 8, "float64").eye, want.eye, atol=1e-4)


@pytest.mark.parametrize("flat", [False, True])
def test_a_shift_moves_the_picture_with_the_hand(flat):
    eye, target = (0.0, 0.0, 5.0), (0.0, 0.0, 0.0)
    make = jaxvr.Camera.orthographic if flat else jaxvr.Camera.look_at
    orbit = Orbit.of(make(eye, target, width=10, height=10), 1.0).shifted(0.1, 0.2)
    height = 1.0 if flat else 2 * 5 * np.tan(np.deg2rad(15))
    np.testing.assert_allclose(orbit.target, [-0.1 * height, -0.2 * height, 0], atol=1e-9)
    out = np.asarray(orbit.camera(10, 10).eye) - orbit.target
    np.testing.assert_allclose(out, [0, 0, 5], atol=1e-5)


UPS = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1)}
UPS |= {f"-{n}": tuple(-x for x in up) for n, up in UPS.items()}
# With z up: where `Camera.orbit` stands for these angles.
SIDES = {"front": "x", "right": "y", "back": "-x", "left": "-y", "top": "z", "bottom": "-z"}


@pytest.mark.parametrize("name", UPS)
def test_another_axis_is_turned_up(view, mesh, name):
    view.apply({"up": name, "turn": [5, 0]})
    want = jaxvr.Camera.orbit(mesh, 35, 20, up=UPS[name], dtype="float64")
    got = view.orbit.camera(8, 8, "float64")
    np.testing.assert_allclose(got.eye, want.eye, atol=1e-5)
    np.testing.assert_allclose(got.basis()[1], want.basis()[1], atol=1e-6)
    assert view.state()["up"] == name


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("name", viewer.VIEWS)
def test_views_by_name_look_along_axes(mesh, name, flat):
    camera = jaxvr.Camera.orbit(mesh, 12, 34, up=(0, 0, 1), zoom=2, width=SIZE, height=SIZE)
    if flat:
        camera = camera.replace(extent=1.0)
    view = Viewer(mesh, TRANSFER, camera)
    distance = np.linalg.norm(np.asarray(camera.eye) - np.asarray(camera.target))
    view.apply({"angles": view.setup()["views"][name]})
    _, up, forward = view.camera.basis()
    out = UPS[SIDES[name]]
    np.testing.assert_allclose(-forward, out, atol=1e-6)
    # From above and below, what was in front is below or above in the picture.
    above = {"top": UPS["-x"], "bottom": UPS["x"]}.get(name, UPS["z"])
    np.testing.assert_allclose(up, above, atol=1e-6)
    state = view.state()
    assert (state["from"], state["up"]) == (SIDES[name], "z")
    away = np.asarray(view.camera.eye) - np.asarray(view.camera.target)
    assert np.linalg.norm(away) == pytest.approx(distance, rel=1e-5)
    assert view.frame(True).exact
    # A hand turns it from there, and to where there is an upper side again.
    view.apply({"turn": [10, 0]})
    assert view.state()["elevation"] == viewer.VIEWS[name][1]
    view.apply({"turn": [0, -1 if name == "top" else 1]})
    assert abs(view.state()["elevation"]) <= 89 and view.state()["from"] == ""


def test_views_and_turns_in_one_message(view):
    """As the script gathers them: a view by name, then turns from there."""
    view.apply({"turn": [3, 4], "angles": [90, 0], "up": "x", "reset": ["view"], "zoom": 2})
    state = view.state()
    assert (state["azimuth"], state["elevation"], state["up"]) == (93, 4, "x")
    assert state["zoom"] == pytest.approx(2 * view._first_orbit.zoom)


@pytest.mark.parametrize(
    "message",
    [{"up": "w"}, {"up": ""}, {"angles": [float("nan"), 0]}, {"angles": [0, float("inf")]}],
    ids=str,
)
def test_views_that_are_none_say_so(view, message):
    before = view.orbit
    with pytest.raises(ValueError, match="must be"):
        view.apply(message)
    assert view.orbit is before


def test_the_axis_that_was_chosen_is_told(mesh):
    from jaxvr.defaults import best_up

    # A thin plate whose field changes along it is seen from its thin side's axis.
    points = np.asarray(mesh.points) * np.array([1, 1, 0.05], "float32")
    plate = mesh.replace(points=points, values=np.asarray(mesh.points)[:, 0])
    view = Viewer(plate, size=SIZE)
    chosen = best_up(plate, view.transfer)
    assert chosen == "z" and view.state()["up"] == "z" and view.state()["chosen"]
    view.apply({"up": "x"})
    assert view.state()["up"] == "x" and not view.state()["chosen"]
    view.apply({"reset": ["view"]})
    assert view.state()["chosen"]
    given = Viewer(plate, camera=jaxvr.Camera.orbit(plate, up=(0, 0, 1), width=8, height=8))
    assert given.state()["up"] == "z" and not given.state()["chosen"]
    tilted = jaxvr.Camera.orbit(plate, up=(0, 1, 1), width=8, height=8)
    assert Viewer(plate, camera=tilted).state()["up"] == "(0, 0.707, 0.707)"


# The transfer function


def test_points_move_between_their_neighbours():
    moved = edits.move(TRANSFER, 1, 0.95, -1.0)
    assert float(moved.positions[1]) == float(TRANSFER.positions[2])  # a jump
    assert float(moved.extinctions[1]) == 0
    # A third point does not fit.
    added = edits.add(moved, 0.5, 1.0)
    pushed = edits.move(added, 1, 2.0, 1.0)
    assert 0.89 < float(pushed.positions[1]) < float(pushed.positions[2])
    free = edits.move(TRANSFER, 2, 7.0, 1.0)
    assert float(free.positions[2]) == 7


@pytest.mark.parametrize("position", [0.1, 0.2, 0.4, 0.5, 0.95])
def test_an_added_point_on_the_curve_changes_nothing(position):
    s = np.linspace(0, 1, 101, dtype="float32")
    color, extinction = TRANSFER(s)
    on_curve = float(TRANSFER(np.float32(position))[1])
    added = edits.add(TRANSFER, position, on_curve)
    assert added.positions.shape == (4,) and added.dtype == TRANSFER.dtype
    np.testing.assert_allclose(added(s)[0], color, atol=1e-6)
    np.testing.assert_allclose(added(s)[1], extinction, atol=1e-5)


def test_points_can_be_added_where_there_is_a_jump():
    jump = jaxvr.TransferFunction([0.5, 0.5], np.eye(2, 3), [1.0, 2.0])
    assert edits.add(jump, 0.5, 1.0).positions.shape == (3,)


def test_points_are_removed_but_the_last():
    left = edits.remove(edits.remove(TRANSFER, 1), 0)
    assert np.asarray(left.positions) == np.float32(0.9)
    with pytest.raises(ValueError, match="last one stays"):
        edits.remove(left, 0)


def test_colours_are_taken_as_they_are():
    changed = edits.apply(TRANSFER, {"edit": "color", "index": 1, "color": "#3380ff"})
    np.testing.assert_allclose(changed.colors[1], np.array([0x33, 0x80, 0xFF]) / 255, rtol=1e-6)


@pytest.mark.parametrize(
    "edit",
    [
        {"edit": "twist"},
        {"edit": "move", "index": 3, "position": 0.1, "extinction": 1},
        {"edit": "move", "index": 0, "position": float("nan"), "extinction": 1},
        {"edit": "add", "position": 0.1, "extinction": None},
        {"edit": "color", "index": 0, "color": "red"},
    ],
)
def test_bad_edits_say_so(edit):
    with pytest.raises(ValueError):
        edits.apply(TRANSFER, edit)


@pytest.mark.parametrize("positions", [[0.2, 0.5, 0.9], [0, 0, 0.5], [-1e30, 0, 1e30], [5, 5, 6]])
def test_padding_keeps_the_function(positions, mesh):
    transfer = TRANSFER.replace(positions=np.array(positions, "float32"))
    padded = edits.padded(transfer)
    assert padded.positions.shape == (8,)
    s = np.linspace(-0.5, 7, 51, dtype="float32")
    for a, b in zip(transfer(s), padded(s), strict=True):
        np.testing.assert_array_equal(a, b)
    nine = jaxvr.TransferFunction(np.arange(9), np.zeros((9, 3)), np.zeros(9))
    assert edits.padded(nine).positions.shape == (16,)
    huge = TRANSFER.replace(positions=np.array([0, 1, 3e38], "float32"))
    assert edits.padded(huge) is huge


# The pace


def test_pace_finds_the_finest_picture_in_time():
    pace = Pace(512, 512, goal=0.06)
    assert pace.size(pace.divisor) == (128, 128) and pace.wanted() == 4
    pace.observe(4, 0.02)
    assert pace.wanted() == 3  # 0.036 s; half the side would take 0.08 s
    pace.divisor = 3
    assert pace.wanted() == 3
    for _ in range(5):
        pace.observe(3, 0.5)
    assert pace.wanted() == 12
    for _ in range(5):
        pace.observe(1, 1000)
    assert pace.wanted() == DIVISORS[-1]
    for _ in range(5):
        pace.observe(1, 0.01)
    assert pace.wanted() == 1


def test_pace_stays_where_it_may():
    pace = Pace(512, 512, goal=0.06)
    pace.observe(4, 0.058)
    assert pace.wanted() == 4
    for _ in range(3):
        pace.observe(4, 0.03)
    assert pace.wanted() == 4  # a finer one would just miss
    fixed = Pace(512, 256, coarse=100)
    fixed.observe(fixed.divisor, 3.0)
    assert fixed.size(fixed.wanted()) == (100, 50)
    assert Pace(16, 4).size(16) == (8, 4)


# The pictures


def test_frames_are_what_render_gives(steady, mesh):
    background = np.ones(3)
    # The first picture is exact whatever was asked for, since nothing is compiled.
    for asked, exact in ((False, True), (True, True), (False, False)):
        frame = steady.frame(asked)
        side = SIZE if exact else 8
        assert (frame.width, frame.height, frame.exact) == (side, side, exact)
        camera = steady.camera.replace(width=side, height=side)
        want = jaxvr.render(mesh, camera, TRANSFER, background=background)
        got = pixels(frame.png)
        assert got.shape == (side, side, 3)
        assert np.abs(got - 255 * np.asarray(want)[..., :3]).max() <= 0.51
        steady.settle()
    want = jaxvr.render(mesh, steady.camera, TRANSFER, background=background)
    np.testing.assert_allclose(steady.image, want, atol=1e-6)


@pytest.fixture
def calls(monkeypatch):
    """Names of the verbs that are called."""
    names = []

    def noted(name, verb):
        def call(*args, **kwargs):
            names.append(name)
            return verb(*args, **kwargs)

        return call

    for name in ("render", "trace", "shade"):
        monkeypatch.setattr(viewer, name, noted(name, getattr(viewer, name)))
    return names


def test_a_standing_view_is_traced_once_and_shaded(steady, mesh, calls):
    steady.frame(False)
    steady.frame(True)
    assert calls == ["render"]  # the same exact picture is not drawn again
    steady.settle()
    steady.settle()
    assert calls == ["render", "render"]
    calls.clear()

    def edit(extinction):
        move = {"edit": "move", "index": 1, "position": 0.5, "extinction": extinction}
        steady.apply({"edits": [move]})

    edit(1.0)
    assert not steady.frame(False).exact and steady.frame(True).exact
    assert calls == ["render", "render"]  # nobody waits for a trace
    calls.clear()
    steady.settle()
    assert calls == ["trace", "shade", "trace", "shade"]
    calls.clear()
    for extinction in (2.0, 3.0):
        edit(extinction)
        steady.frame(False)
    steady.frame(True)
    steady.settle()
    assert calls == ["shade", "shade", "shade"]
    want = jaxvr.render(mesh, steady.camera, steady.transfer, background=np.ones(3))
    np.testing.assert_allclose(steady.image, want, atol=1e-5)
    calls.clear()
    steady.apply({"turn": [10, 0]})
    steady.frame(False)
    assert calls == ["render"]


def test_segments_of_a_view_that_was_left_are_dropped(view, monkeypatch):
    view.edit([{"edit": "color", "index": 0, "color": "#ffffff"}])
    trace = viewer.trace

    def leaves(*args, **kwargs):
        view.apply({"turn": [10, 0]})
        return trace(*args, **kwargs)

    monkeypatch.setattr(viewer, "trace", leaves)
    view.settle()
    assert not view._segments


def test_too_many_segments_are_not_kept(view, calls, monkeypatch):
    view.edit([{"edit": "color", "index": 0, "color": "#ffffff"}])
    monkeypatch.setattr(viewer, "SEGMENT_BYTES", 10)
    view.settle()
    assert calls.count("trace") == 1 and 1 not in view._segments
    calls.clear()
    assert view.frame(True).exact and calls == ["render"]


def test_settling_prepares_the_next_size(view):
    view.frame(True)
    pace = view._paces["render"]
    assert not view._ready(pace.divisor)
    view.settle()
    assert view._ready(pace.divisor)
    for _ in range(5):
        pace.observe(1, 1.0)
    assert pace.wanted() > 4
    view.settle()
    assert pace.divisor > 4 and view._ready(pace.divisor)


def test_reset_comes_first(view):
    first = view.orbit
    view.apply({"turn": [10, 5], "zoom": 2, "shift": [0.1, 0]})
    assert view.orbit.zoom == 2 * first.zoom
    assert view.orbit.azimuth == pytest.approx(first.azimuth + 10)
    view.edit([{"edit": "remove", "index": 0}])
    view.apply({"reset": ["view", "transfer"], "turn": [1, 0]})
    assert view.orbit.azimuth == pytest.approx(first.azimuth + 1)
    assert view.orbit.zoom == first.zoom
    assert view.transfer is TRANSFER


def test_tables_see_no_unused_points(mesh):
    view = Viewer(mesh, TRANSFER, size=SIZE, integrator=jaxvr.Quadrature())
    assert view._drawn() is TRANSFER


def test_default_transfer_function_spans_the_values(mesh):
    view = Viewer(mesh, size=SIZE)
    wanted = jaxvr.default_transfer(mesh, points=6).positions  # quantiles by volume
    np.testing.assert_array_equal(view.transfer.positions, wanted)
    assert view.setup()["range"] == [float(mesh.values.min()), float(mesh.values.max())]
    assert sum(view.setup()["counts"]) == mesh.values.size
    flat = mesh.replace(values=np.zeros(mesh.n_points))
    assert Viewer(flat, size=SIZE).transfer.positions.shape == (1,)


def test_what_the_default_transfer_function_spans_is_told(mesh):
    """While it is shown: the 1 and 99 % quantiles by volume, or the whole range."""
    fine = jaxvr.datasets.box((6, 6, 6), dtype="float32")
    rising = fine.replace(values=np.linspace(0, 1, fine.n_tets), location="cell")
    view = Viewer(rising, size=SIZE)
    low, high = (float(view.transfer.positions[k]) for k in (0, -1))
    told = view.state()["told"]
    assert f"spans {low:.4g} to {high:.4g}, the 1 and 99 % quantiles" in told and 0 < low < high < 1
    assert "values go from 0 to 1" in told
    view.apply({"edits": [{"edit": "remove", "index": 0}]})
    assert view.state()["told"] == ""
    view.apply({"reset": ["transfer"]})
    assert view.state()["told"] == told
    assert Viewer(mesh, TRANSFER, size=SIZE).state()["told"] == ""
    flat = mesh.replace(values=np.full(mesh.n_points, 3.0))
    assert "the field is 3 everywhere" in Viewer(flat, size=SIZE).state()["told"]
    two = np.where(np.arange(mesh.n_tets) < mesh.n_tets // 2, 1.0, 2.0)
    two = mesh.replace(values=two, location="cell")
    assert "the whole range, 1 to 2" in Viewer(two, size=SIZE).state()["told"]


@pytest.mark.parametrize(
    "change",
    [
        {"volume": 3},
        {"transfer": "turbo"},
        {"camera": 3},
        {"coarse": 0},
        {"background": (1, 1)},
        {"background": (1, 1, np.nan)},
        {"size": 0},
    ],
    ids=str,
)
def test_bad_arguments_say_so(mesh, change):
    with pytest.raises(ValueError):
        Viewer(**{"volume": mesh, "size": SIZE} | change)


# The widget


@pytest.fixture
def explorer(mesh, monkeypatch):
    from jaxvr.interact import explore

    camera = jaxvr.Camera.orbit(mesh, width=SIZE, height=SIZE)
    widget: Any = explore(mesh, TRANSFER, camera, coarse=8)
    sent: Any = []
    monkeypatch.setattr(
        widget, "send", lambda content, buffers=None: sent.append((content, buffers))
    )
    monkeypatch.setattr(widget, "sent", sent, raising=False)
    yield widget
    if widget._settling is not None:
        widget._settling.join()


def ask(widget, **message):
    """What the browser does, and what it gets."""
    widget.sent.clear()
    widget._handle_custom_msg({"kind": "frame", "view": "v", **message}, [])
    (answer,) = widget.sent
    return answer


def test_an_answer_has_picture_and_state(explorer, mesh):
    answer, buffers = ask(explorer, exact=False)
    size = SIZE if answer["exact"] else 8  # exact until the coarse size is compiled
    assert pixels(buffers[0]).shape == (size, size, 3)
    explorer._settling.join()
    answer, buffers = ask(explorer, exact=False, zoom=1.1)
    assert not answer["exact"] and (answer["width"], answer["height"]) == (8, 8)
    assert pixels(buffers[0]).shape == (8, 8, 3)
    answer, buffers = ask(explorer, exact=True, turn=[5, 0])
    assert answer["exact"] and answer["view"] == "v" and answer["milliseconds"] > 0
    assert answer["state"]["azimuth"] == pytest.approx(35, rel=1e-5)
    assert answer["state"]["positions"] == pytest.approx([0.2, 0.5, 0.9])
    assert answer["state"]["colors"] == ["#ff0000", "#00ff00", "#0000ff"]
    want = jaxvr.render(mesh, explorer.camera, explorer.transfer, background=np.ones(3))
    np.testing.assert_allclose(explorer.image, want, atol=1e-6)
    assert np.abs(pixels(buffers[0]) - 255 * explorer.image[..., :3]).max() <= 0.51


def test_edits_come_back(explorer):
    edit = {"edit": "add", "position": 0.7, "extinction": 3}
    answer, _ = ask(explorer, exact=True, edits=[edit])
    assert answer["state"]["extinctions"] == pytest.approx([0, 4, 3, 2])
    assert explorer.transfer.positions.shape == (4,)
    explorer.sent.clear()
    explorer.transfer = TRANSFER
    ((told, _),) = explorer.sent
    assert told["kind"] == "changed" and len(told["state"]["positions"]) == 3
    assert explorer.transfer is TRANSFER


def test_errors_are_shown(explorer, monkeypatch):
    answer, buffers = ask(explorer, exact=False, edits=[{"edit": "remove", "index": 9}])
    assert "no control point 9" in answer["error"] and buffers is None
    assert len(answer["state"]["positions"]) == 3

    def lost(*args, **kwargs):
        raise jaxvr.RenderError("1 ray(s) found no way out of a cell")

    monkeypatch.setattr(viewer, "render", lost)
    answer, _ = ask(explorer, exact=False, turn=[1, 0])
    assert "no way out" in answer["error"]

    def broken(*args, **kwargs):
        raise KeyError("x")

    # What is a bug goes on, but whoever waits is told.
    monkeypatch.setattr(viewer, "render", broken)
    explorer.sent.clear()
    with pytest.raises(KeyError):
        explorer._receive(explorer, {"kind": "frame", "exact": False}, [])
    assert "KeyError" in explorer.sent[0][0]["error"]


def test_image_is_rendered_when_asked_for(explorer):
    assert explorer.image.shape == (SIZE, SIZE, 4)
    assert "Explorer(TetMesh(" in repr(explorer)


def test_script_and_style_are_there(explorer):
    assert "export default { render }" in str(explorer._esm)
    assert ".jaxvr-explorer" in str(explorer._css)


def test_the_script_sends_what_the_viewer_takes(explorer):
    """Parts of a request, `p` in the script, against those in the docstring of `apply`."""
    sent = set(re.findall(r"\bp\.([a-z]+)", str(explorer._esm))) - {"x", "e", "color"}
    taken = set(re.findall(r"(\w+):", Viewer.apply.__doc__ or ""))
    assert sent == taken
    state = set(re.findall(r"\bstate\.(\w+)", str(explorer._esm)))
    assert state <= set(explorer._viewer.state())
    setup = set(re.findall(r"\bsetup\.(\w+)", str(explorer._esm))) | {"width", "height"}
    assert setup == set(explorer.setup)


def test_buttons_are_answered(explorer, mesh):
    answer, buffers = ask(explorer, exact=True, up="z", angles=explorer.setup["views"]["top"])
    assert (answer["state"]["up"], answer["state"]["from"]) == ("z", "z")
    want = jaxvr.render(mesh, explorer.camera, TRANSFER, background=np.ones(3))
    assert np.abs(pixels(buffers[0]) - 255 * np.asarray(want)[..., :3]).max() <= 0.51
    assert list(explorer.setup["ups"]) == list(UPS)
    answer, _ = ask(explorer, exact=False, up="north")
    assert "up must be one of x, y, z" in answer["error"] and answer["state"]["up"] == "z"


def test_without_anywidget_it_says_what_to_install(mesh, monkeypatch):
    from jaxvr.interact import explore

    monkeypatch.setitem(sys.modules, "anywidget", None)
    monkeypatch.delitem(sys.modules, "jaxvr.interact.widget", raising=False)
    with pytest.raises(ImportError, match=r"pip install anywidget jupyterlab"):
        explore(mesh)
