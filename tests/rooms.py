"""The part of the tests that touches every room, with both engines: `pytest -m rooms`.

`make quick` runs it after a change, `make pythons` with other versions of Python and JAX. What is
chosen is what is quick; on Python 3.12 and later, which can watch that at no cost, a run in which
some room was not entered fails.
"""

from __future__ import annotations

import inspect
import sys
from pathlib import Path

import pytest

import jaxvr

HERE = Path(__file__).parent
HOUSE = Path(jaxvr.__file__).parent

# Modules, with the names of tests or parts of their ids; none of them: all.
CHOSEN: dict[str, tuple[str, ...]] = {
    "adjoint/test_adjoints.py": ("test_modes_that_an_adjoint", "test_nothing_to_differentiate"),
    "composite/test_back_to_front.py": ("test_what_an_opaque_piece_hides",),
    "composite/test_over.py": (),
    "fit/test_loop.py": (),
    "fit/test_parts.py": ("test_parameters_move_only_what_is_free",),
    "interact/test_explorer.py": ("test_an_answer_has_picture_and_state", "test_edits_come_back"),
    "interact/test_reprs.py": (),
    "native/test_native.py": (
        "test_the_default_is_compiled",
        "test_rays_of_all_directions_in_one_packet",
        "test_what_they_do_not_cover",
        "test_library_is_built_once",
    ),
    "numerics/test_exact.py": (),
    "numerics/test_tables.py": (),
    "optics/test_end_models.py": ("test_slab", "test_gradients_are_finite"),
    "optics/test_transfer.py": ("test_dtype",),
    "optics/test_transfer_json.py": (),
    "order/test_keys.py": ("float32",),
    "order/test_sequence.py": (),
    "test_architecture.py": (),
    "test_cli.py": ("test_render_png", "test_fit", "test_errors_are_one_line"),
    "test_files.py": ("png", "gif", "mp4", "exr"),
    "test_plot.py": ("test_history_of_losses", "test_k_map_has", "test_the_histogram_counts"),
    "test_probe.py": ("test_bad_calls",),
    "test_registry.py": ("RayCast-Analytic-Replay-point]", "RayCast-Analytic-compiled-point]"),
    "test_render.py": (
        "test_rays_are_the_camera_s",
        "test_gradient_of_shade_is_that_of_render",
        "test_new_floats_do_not_compile_again",
        "test_bad_arguments",
    ),
    "test_testing.py": ("test_nasty_rays", "nasty_meshes[one]", "test_differences_know"),
    "test_accessors.py": ("test_a_volume_that_was_moved",),
    "test_units.py": ("test_powers_of_two",),
    "test_without_x64.py": ("test_float64_input",),
    "trace/test_raycast.py": ("test_touching_boxes", "test_rays_that_miss"),
    "trace/test_recorded.py": (),
    "view/test_camera.py": (),
    "view/test_images.py": ("test_srgb_there_and_back", "test_unpremultiply"),
    "volume/test_readers.py": ("test_list_fields", "test_round_trips", "test_fields_by_name"),
    "volume/test_tetmesh.py": (),
    "volume/test_weld.py": (),
}
WITHOUT_FUNCTIONS = {"__init__", "__main__"}

entered: set[str] = set()


def whole(config: pytest.Config) -> bool:
    """Whether this runs the chosen tests, all of them and no others."""
    return (
        config.getoption("markexpr") == "rooms"
        and not config.getoption("keyword")
        and not config.getoption("collectonly")
        and config.args == config.getini("testpaths")
    )


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Modules of which nothing is chosen are not even imported."""
    inside = HERE in collection_path.parents and collection_path.suffix == ".py"
    if inside and whole(config) and _name(collection_path) not in CHOSEN:
        return True


@pytest.hookimpl(tryfirst=True)  # before those with other marks are left out
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    missed = {(module, part) for module, parts in CHOSEN.items() for part in parts or ("",)}
    for item in items:
        module = _name(item.path)
        for part in CHOSEN[module] or ("",) if module in CHOSEN else ():
            if part in item.name:
                missed.discard((module, part))
                item.add_marker("rooms")
    if whole(config):
        if missed:
            raise pytest.UsageError(f"tests/rooms.py names what is not there: {sorted(missed)}")
        _watch()


def pytest_sessionfinish(session: pytest.Session) -> None:
    output = getattr(session.config, "workeroutput", None)
    if output is not None:  # a worker of pytest-xdist: the main process puts them together
        output["rooms"] = sorted(entered)
    elif left_out(session.config) and session.exitstatus == 0:
        session.exitstatus = 1


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node, error) -> None:
    entered.update(getattr(node, "workeroutput", {}).get("rooms", ()))


def pytest_terminal_summary(terminalreporter, config: pytest.Config) -> None:
    if names := left_out(config):
        terminalreporter.write_line(f"No test entered {', '.join(names)}: see tests/rooms.py")


def left_out(config: pytest.Config) -> list[str]:
    """Rooms that were not entered, where that was watched."""
    if not whole(config) or sys.version_info < (3, 12):
        return []
    return sorted({_room(path) for path in HOUSE.rglob("*.py")} - WITHOUT_FUNCTIONS - entered)


def _name(path: Path) -> str:
    return path.relative_to(HERE).as_posix()


def _room(path: Path) -> str:
    return path.relative_to(HOUSE).parts[0].removesuffix(".py")


def _watch() -> None:
    """Notes the rooms whose functions are called. (What runs when they are imported is past.)"""
    if sys.version_info >= (3, 12):
        tool, start = sys.monitoring, sys.monitoring.events.PY_START

        def called(code, offset):
            path = Path(code.co_filename)
            if HOUSE in path.parents and code.co_flags & inspect.CO_OPTIMIZED:
                entered.add(_room(path))
            return tool.DISABLE  # a function tells once

        tool.use_tool_id(tool.PROFILER_ID, "rooms")
        tool.register_callback(tool.PROFILER_ID, start, called)
        tool.set_events(tool.PROFILER_ID, start)
