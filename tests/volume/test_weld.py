"""Welding by exactly equal coordinates, and the sign of a volume."""

from fractions import Fraction

import numpy as np

from jaxvr.volume.geometry import signed_volumes
from jaxvr.volume.weld import weld


def test_lowest_index_represents(dtype):
    p = np.array([[1, 2, 3], [0, 0, 0], [1, 2, 3], [-0.0, 0.0, -0.0], [1, 2, 3]], dtype)
    welded, duplicates = weld(p)
    assert welded.tolist() == [0, 1, 0, 1, 0]
    assert duplicates.tolist() == [[2, 0], [3, 1], [4, 0]] and duplicates.dtype == np.int32


def test_nearly_equal_points_stay_apart(dtype):
    p = np.array([[1, 0, 0], [np.nextafter(np.array(1, dtype), 2), 0, 0]], dtype)
    welded, duplicates = weld(p)
    assert welded.tolist() == [0, 1] and duplicates.shape == (0, 2)


def test_against_a_dict():
    rng = np.random.default_rng(1)
    p = rng.integers(0, 5, (500, 3)).astype(np.float32)
    first, expected = {}, []
    for i, row in enumerate(p.tolist()):
        expected.append(first.setdefault(tuple(row), i))
    welded, duplicates = weld(p)
    assert welded.tolist() == expected
    assert duplicates.tolist() == [[i, w] for i, w in enumerate(expected) if i != w]


def exact(points):
    rows = [[Fraction(float(x)) for x in p] for p in points]
    a, b, c = ([x - y for x, y in zip(r, rows[0], strict=True)] for r in rows[1:])
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


def test_signs_are_exact_or_zero_and_nonzero_where_there_is_volume(dtype):
    rng = np.random.default_rng(2)
    p = rng.normal(size=(400, 4, 3)).astype(dtype)
    flat = p[:200]
    flat[:, 3] = flat[:, 0] + (flat[:, 1] - flat[:, 0]) * 0.25  # nearly coplanar, by rounding
    tets = np.arange(1600).reshape(-1, 4)
    det, sign = signed_volumes(p.reshape(-1, 3), tets)
    for i in range(400):
        true = exact(p[i])
        assert sign[i] in (0, (true > 0) - (true < 0))
        assert abs(float(true) - det[i]) <= 1e-14 * max(1.0, abs(det[i]))
    assert (sign[200:] != 0).all()


def test_coordinates_of_any_size():
    tet = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
    for scale in (1e-200, 1e-30, 1.0, 1e30, 1e200):
        _, sign = signed_volumes(tet * scale, np.array([[0, 1, 2, 3], [0, 2, 1, 3]]))
        assert sign.tolist() == [1, -1]
