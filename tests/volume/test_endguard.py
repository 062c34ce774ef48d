"""Reading behind the end of a file ends in an error, and only there."""

import meshio
import numpy as np
import pytest
from meshio import _files

from jaxvr.volume import endguard


def test_reads_at_the_end_are_counted(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"one\ntwo\n")
    for mode, empty in (("r", ""), ("rb", b"")):
        with endguard._open(path, mode) as f:
            assert len(list(f)) == 2
            f.seek(0)
            assert len(f.read()) == 8 and f.read(0) == empty
            for _ in range(endguard.PATIENCE - 10):
                assert f.readline() == empty
            f.seek(0)
            assert f.readline().strip() in ("one", b"one")  # starts the count again
            with pytest.raises(EOFError, match="too early"):
                while True:
                    f.read(1)


def test_numpy_reads_such_files(tmp_path):
    np.arange(5, dtype=np.int32).tofile(tmp_path / "a.bin")
    with endguard._open(tmp_path / "a.bin", "rb") as f:
        f.read(4)
        assert np.fromfile(f, np.int32, 2).tolist() == [1, 2] and f.read(4) == b"\3\0\0\0"


def test_meshio_is_left_as_it_was(tmp_path):
    with pytest.raises(KeyError):
        with endguard.ending():
            assert vars(_files)["open"] is endguard._open
            raise KeyError
    assert "open" not in vars(_files)


def test_a_reader_that_waits_for_a_line(tmp_path):
    path = tmp_path / "cut.off"
    path.write_bytes(b"OFF\n")
    with endguard.ending(), pytest.raises(EOFError):
        meshio.off.read(path)
