"""The processes that read files: crashes, threads, forks, what they print."""

import os
import subprocess
import sys
import threading
import warnings

import numpy as np
import pytest

from jaxvr.volume import datasets, list_fields, read_mesh, write_mesh
from jaxvr.volume.io import process


def test_a_reader_that_crashes(tmp_path, monkeypatch):
    """What it does to its process does not reach this one; the next file is read."""
    path = tmp_path / "a.vtu"
    write_mesh(path, datasets.box((1, 1, 1)))
    crashing = tmp_path / "child.py"  # takes the request, and is killed
    crashing.write_text(
        "import os, sys\nsys.stdin.buffer.read(1)\nos.write(1, b'!')\nos.kill(os.getpid(), 9)\n"
    )
    monkeypatch.setattr(process, "_CHILD", crashing)
    monkeypatch.setattr(process._pool, "idle", [])
    with pytest.raises(ValueError, match="takes more memory"):  # as the system ends those that do
        read_mesh(path)
    assert process._pool.idle == []
    monkeypatch.undo()
    assert read_mesh(path).n_tets == 6


def test_a_process_that_ended_while_idle_is_replaced(tmp_path):
    path = tmp_path / "a.vtu"
    write_mesh(path, datasets.box((1, 1, 1)))
    for worker in process._pool.idle:
        worker.kill()
        worker.wait()
    assert read_mesh(path).n_tets == 6


def test_threads_change_nothing_of_the_process(tmp_path, capsys):
    streams, filters = (sys.stdout, sys.stderr), list(warnings.filters)
    mesh = datasets.box((2, 2, 2), field=lambda p: p[:, 0])
    failed = []

    def work(k):
        try:
            for n in range(5):
                path = tmp_path / f"{k}.{'vtu' if n % 2 else 'vtk'}"
                write_mesh(path, mesh)
                assert np.array_equal(read_mesh(path).values, mesh.values)
                with pytest.raises(ValueError, match="damaged"):
                    (tmp_path / f"{k}.bad.vtu").write_text("<VTKFile")
                    list_fields(tmp_path / f"{k}.bad.vtu")
        except BaseException as e:
            failed.append(e)

    threads = [threading.Thread(target=work, args=(k,)) for k in range(6)]
    for t in threads:
        t.start()
    for n in range(2000):
        print("a line")
    for t in threads:
        t.join()
    assert not failed
    assert (sys.stdout, sys.stderr) == streams and warnings.filters == filters
    said = capsys.readouterr()
    assert said.out.count("a line") == 2000 and not said.err


def test_python_that_does_not_start(tmp_path, monkeypatch):
    write_mesh(tmp_path / "a.vtu", datasets.box((1, 1, 1)))
    (tmp_path / "child.py").write_text("raise SystemExit(3)")
    monkeypatch.setattr(process, "_CHILD", tmp_path / "child.py")
    monkeypatch.setattr(process._pool, "idle", [])
    with pytest.raises(OSError, match="Python could not be started to read files .exit code 3"):
        read_mesh(tmp_path / "a.vtu")


def test_the_end_of_much_output_is_kept():
    code = (
        f"import runpy, sys; child = runpy.run_path({process.child.__file__!r});"
        "import os; out = os.dup(1); q = child['_Quiet']();"
        "print('first' + 'x' * 100000 + 'last'); said = q.take();"
        "os.write(out, (said[:5] + said.strip()[-4:] + str(len(said) < 50000)).encode())"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert done.stdout == b"firstlastTrue"


def test_a_forked_process_closes_what_it_got(tmp_path, monkeypatch):
    write_mesh(tmp_path / "a.vtu", datasets.box((1, 1, 1)))
    pool = process._Pool()
    monkeypatch.setattr(process, "_pool", pool)
    read_mesh(tmp_path / "a.vtu")
    (worker,) = pool.idle
    process._forked()
    assert process._pool is not pool and worker.stdin and worker.stdout
    assert worker.stdin.closed and worker.stdout.closed
    os.waitpid(worker.pid, 0)  # it ends with its input
    assert worker.returncode == 0
