"""Tests on outside data: left out and counted, an error with CI=true, a failure of one file."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import experiments.data
from experiments import exactness, lost_rays

TESTS = """
import pytest

@pytest.mark.outside("a.vtu")
@pytest.mark.parametrize("n", range(3))
def test_a(data_path, n):
    assert data_path("a.vtu").read_text() == "a"

@pytest.mark.outside("a.vtu", "vectors/v.npz")
def test_both(data_path):
    data_path("a.vtu"), data_path("vectors/v.npz")

def test_neither():
    pass
"""


@pytest.fixture
def session(tmp_path):
    """Runs a small session in a clone with nothing beside it."""
    clone = tmp_path / "folder" / "clone" / "tests"
    clone.mkdir(parents=True)
    shutil.copy(Path(__file__).with_name("outside.py"), clone)
    (clone.parent / "experiments").mkdir()
    for name in ("__init__.py", "data.py"):
        shutil.copy(Path(experiments.data.__file__).with_name(name), clone.parent / "experiments")
    (clone / "conftest.py").write_text(
        "import outside\n"
        "def pytest_configure(config):\n"
        "    config.pluginmanager.register(outside)\n"
    )
    (clone / "test_it.py").write_text(TESTS)

    def run(*options, **variables):
        ours = ("CI", "JAXVR_DATA", "JAXVR_VECTORS")
        env = {k: v for k, v in os.environ.items() if k not in ours and "PYTEST" not in k}
        command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-q", *options]
        command += ["-o", f"pythonpath={clone.parent}"]
        done = subprocess.run(
            command, cwd=clone, env=env | variables, capture_output=True, text=True, timeout=120
        )
        return done.returncode, done.stdout + done.stderr

    run.beside = clone.parents[1] / "shared"
    return run


LINE = "left out: 4 tests, which need a.vtu (4), vectors/v.npz (1): set JAXVR_DATA and JAXVR_VECT"


@pytest.mark.parametrize("options", [(), ("-n", "2")])
def test_left_out_and_counted_once(session, options):
    code, told = session(*options)
    assert code == 0 and told.count("left out: ") == 1 and LINE in told and "1 passed" in told


def test_chosen_tests_only_are_counted(session):
    assert "left out: 1 tests, which need a.vtu (1), vec" in session("-k", "both or neither")[1]


@pytest.mark.parametrize("options", [(), ("-n", "2")])
def test_missing_folder_is_an_error_with_ci(session, options):
    code, told = session(*options, CI="true")
    assert code == 4 and told.count("CI is set, and the folder of the outside data") == 1, told
    assert "passed" not in told


def test_none_says_that_it_is_meant(session):
    code, told = session(CI="true", JAXVR_DATA="none")
    assert code == 0 and LINE in told
    session.beside.mkdir()
    (session.beside / "data").mkdir()
    assert LINE in session(JAXVR_DATA="none")[1]
    code, told = session(CI="true", JAXVR_DATA="none", JAXVR_VECTORS="/nowhere")
    assert code == 4 and "outside vectors, /nowhere, is not there" in told


def test_folder_that_lacks_a_file_fails_and_names_it(session):
    (session.beside / "data").mkdir(parents=True)
    (session.beside / "vectors").mkdir()
    code, told = session()
    assert code == 1 and "a.vtu is missing in " in told and "left out: " not in told
    (session.beside / "data" / "a.vtu").write_text("a")
    code, told = session(CI="true")
    assert code == 1 and "v.npz is missing in " in told and "1 failed, 4 passed" in told
    (session.beside / "vectors" / "v.npz").touch()
    code, told = session(CI="true")
    assert code == 0 and "5 passed" in told


def test_experiments_know_the_same_folders(tmp_path):
    """`none` is no folder of that name, wherever a script is started."""
    (tmp_path / "can.vtu").touch()
    found = experiments.data.path_of("can.vtu", {"JAXVR_DATA": str(tmp_path)})
    assert found == tmp_path / "can.vtu"
    for environment, words in (
        ({"JAXVR_DATA": "none"}, "JAXVR_VECTORS is none"),
        ({"JAXVR_DATA": str(tmp_path), "JAXVR_VECTORS": "none"}, "JAXVR_VECTORS is none"),
        ({"JAXVR_DATA": "none", "JAXVR_VECTORS": str(tmp_path)}, f"v.npz is missing in {tmp_path}"),
    ):
        with pytest.raises(FileNotFoundError, match=words):
            experiments.data.path_of("vectors/v.npz", environment)


@pytest.mark.parametrize("script", [exactness, lost_rays], ids=lambda x: x.__name__)
def test_scripts_say_that_there_are_no_data(script, monkeypatch, capsys):
    monkeypatch.setenv("JAXVR_DATA", "none")
    with pytest.raises(SystemExit) as ended:
        script.main([])
    assert ended.value.code == 2
    assert "bluntfin.vtu is not at hand: JAXVR_DATA is none" in capsys.readouterr().err
