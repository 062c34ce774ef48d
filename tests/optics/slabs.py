"""Slabs and their derivatives by a rule of many nodes in extended precision, as reference."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np


def _slab(x, t, weights):
    """rgb and alpha of slabs x (n, 9) = (tau_f, tau_b, C_f, C_b, l), by a rule for t in [0, 1]:
    rgb = int C(t) tau(t) l exp(-l (tau_f t + (tau_b - tau_f) t^2 / 2)) dt. Complex numbers pass."""
    tau_f, tau_b, length = x[:, :1], x[:, 1:2], x[:, 8:9]
    through = np.exp(-length * (tau_f * t + (tau_b - tau_f) * t * t / 2))
    light = (tau_f + (tau_b - tau_f) * t) * length * through * weights
    color = x[:, 2:5, None] + (x[:, 5:8] - x[:, 2:5])[..., None] * t
    alpha = -np.expm1(-length * (tau_f + tau_b) / 2)
    return np.concatenate([(color * light[:, None]).sum(2), alpha], 1), through


def _nodes(count):
    """Gauss-Legendre nodes and weights on [0, 1] in long doubles: NumPy's, by Newton's steps on the
    recurrence of the Legendre polynomials."""
    x = np.polynomial.legendre.leggauss(count)[0].astype(np.longdouble)
    slope = x
    for _ in range(3):
        last, this = np.ones_like(x), x
        for n in range(2, count + 1):
            last, this = this, ((2 * n - 1) * x * this - (n - 1) * last) / n
        slope = count * (x * this - last) / (x * x - 1)
        x = x - this / slope
    return (x + 1) / 2, 1 / ((1 - x * x) * slope**2)


def write(path: Path, count: int = 1200, deepest: float = 9.0) -> None:
    """An .npz of slabs, up to an optical depth, with the names of the public reference vectors.

    Derivatives are imaginary parts at a step of 1e-30: no difference, so no cancellation. In long
    doubles, since in float64 a sum over so many nodes is off by more than what it tests.
    """
    rng = np.random.default_rng(5)
    x = rng.uniform(0, 1, (count, 9))
    x[:, :2] *= deepest ** rng.uniform(0, 1, (count, 1))
    x[::10, 0] = x[::10, 1]
    x[5::10, 1] = 0
    x = x.astype(np.float32).astype(np.longdouble)
    t, weights = _nodes(48)
    result, through = _slab(x, t, weights)
    step = np.longdouble(1e-30)
    steps = [np.imag(_slab(x + 1j * step * np.eye(9)[k], t, weights)[0]) / step for k in range(9)]
    basis = np.stack([(1 - t) ** 2, 2 * t * (1 - t), t * t])
    jac = np.stack(steps, -1)
    rows = {
        **{"tau_f": x[:, 0], "tau_b": x[:, 1], "C_f": x[:, 2:5], "C_b": x[:, 5:8], "l": x[:, 8]},
        **{"rgb": result[:, :3], "alpha": result[:, 3], "jac": jac},
        **{"w_f": jac[:, 0, 2], "w_b": jac[:, 0, 5]},
        "B": (basis * (through * weights)[:, None]).sum(2),
    }
    stored: dict[str, Any] = {name: row.astype(float) for name, row in rows.items()}
    np.savez(path, **stored, f32_exact_inputs=np.ones(len(x), bool))
