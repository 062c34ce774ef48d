"""Files read inside of an application that is no Python: nothing is started, and it is told."""

import multiprocessing.spawn
import subprocess
import sys
import warnings

import numpy as np
import pytest

from jaxvr._core import interpreter
from jaxvr.volume import datasets, list_fields, read_mesh, write_mesh
from jaxvr.volume.io import process


@pytest.fixture
def host(monkeypatch, tmp_path):
    """A program that embeds Python, with none beside it."""
    monkeypatch.setattr(sys, "executable", str(tmp_path / "Slicer"))
    monkeypatch.setattr(multiprocessing.spawn, "_python_exe", str(tmp_path / "Slicer"))
    for name in ("prefix", "exec_prefix", "base_prefix"):
        monkeypatch.setattr(sys, name, str(tmp_path))
    monkeypatch.setattr(process, "_warned", False)

    def started(*args, **kwargs):
        raise AssertionError(f"{args} was started")

    monkeypatch.setattr(subprocess, "Popen", started)
    return tmp_path


@pytest.mark.parametrize(
    ("path", "python"),
    [
        ("/usr/bin/python3.12", True), ("/opt/PythonSlicer", True), ("/a/Python", True),
        (r"C:\Python\python_d.exe", True), (r"C:\a\pythonw.exe", True), ("/a/pypy3", True),
        ("/usr/bin/python3.13t", True), ("/opt/Slicer", False), (r"C:\QGIS\qgis-bin.exe", False),
        ("/opt/blender", False), ("/usr/bin/pvpython", False), ("/usr/bin/uwsgi", False),
        ("/opt/python3.12/bin/app", False), ("", False),
    ],
)  # fmt: skip
def test_which_programs_are_python(path, python):
    assert interpreter.is_python(path) is python


def test_the_python_to_start(host, monkeypatch):
    assert interpreter.python() is None
    beside = host / "bin" / "python{}.{}".format(*sys.version_info)
    beside.parent.mkdir()
    (host / "bin" / "python2.7").touch()
    assert interpreter.python() is None
    beside.touch()
    assert interpreter.python() == str(beside)
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    assert interpreter.python() is None
    multiprocessing.set_executable("/opt/snake")
    assert interpreter.python() == "/opt/snake"


def test_frozen_applications_are_not_started_whatever_their_name(host, monkeypatch):
    monkeypatch.setattr(sys, "frozen", True, raising=False)
    monkeypatch.setattr(sys, "executable", "/opt/python")
    monkeypatch.setattr(multiprocessing.spawn, "_python_exe", "/opt/python")
    assert interpreter.python() is None


def test_files_are_read_and_written_in_the_host(host):
    """With the same answers, and one warning."""
    mesh = datasets.box((2, 1, 1), field=lambda p: p[:, 0])
    path = host / "a.vtu"
    with pytest.warns(process.Unguarded, match=r"inside of .*Slicer.*set_executable") as caught:
        write_mesh(path, mesh)
    assert len(caught) == 1 and caught[0].filename == __file__
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.array_equal(read_mesh(path).values, mesh.values)
        assert [f.name for f in list_fields(path)] == ["values"]
        for name, words in (("a.qqq", "unknown kind"), ("b.vtu", "damaged"), ("c.vtk", "damaged")):
            (host / name).write_text("<VTKFile" if name == "b.vtu" else "# vtk DataFile" * 3)
            (host / "a.qqq").write_text("something")
            with pytest.raises(ValueError, match=words):
                read_mesh(host / name)
        with pytest.raises(ValueError, match="no field 'x'"):
            read_mesh(path, "x")


def test_what_vtk_says_is_heard_in_the_host(host, monkeypatch):
    from vtkmodules.vtkCommonCore import vtkOutputWindow

    monkeypatch.setattr(process, "_warned", True)
    window = vtkOutputWindow.GetInstance()
    mesh = datasets.box((1, 1, 1))
    write_mesh(host / "a.vtu", mesh)
    text = (host / "a.vtu").read_bytes()
    (host / "b.vtu").write_bytes(text[: len(text) // 2])
    with pytest.raises(ValueError, match="vtkXMLUnstructuredGridReader"):
        read_mesh(host / "b.vtu")
    assert vtkOutputWindow.GetInstance() is window


def test_a_reader_that_may_not_end_is_no_reader_in_the_host(host, monkeypatch):
    from jaxvr.volume.io import vtk_files
    from jaxvr.volume.io.content import Ask, Trouble

    (host / "a.dat").write_text('VARIABLES = "X" "Y" "Z"\nZONE N=4')
    with pytest.raises(Trouble, match="may wait for ever"):
        vtk_files.read(host / "a.dat", Ask(alone=False), str, ".dat")
    monkeypatch.setattr(process, "_warned", True)
    with pytest.raises(ValueError, match=r"a\.dat"):
        read_mesh(host / "a.dat")
