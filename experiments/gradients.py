"""Are gradients right? Every parameter class against differences, and adjoint against adjoint.

    python experiments/gradients.py [--locations point cell corner] [--tiny] [--json FILE]

A smooth loss (weighted squares of rgba against a random target) of 6 x 6 rays through a box of
jittered tetrahedra, as a function of everything at once: control points, values, points, camera,
and an offset of each ray's origin and direction. For each class of parameters the derivative along
two random directions is compared with central differences in float64, extrapolated (Richardson,
with the step whose two finest extrapolations agree best: chosen without looking at the gradient).

Differences mean something only where the image is smooth, so no ray is near the box's silhouette,
and none lies in a face. With continuous data the image is C^1 everywhere else; its second
derivative jumps where a ray sweeps over an edge or a control point over a scalar met at a face.
Thirty-six rays meet some thousand edges per unit of length that they are moved, hence steps of 1e-4
and less for what moves rays. Where a parameter has one side only (extinction 0, the
two halves of a jump drawn apart), differences are one-sided.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import jax
import jax.numpy as jnp

import jaxvr
from jaxvr.volume import datasets

CLASSES = (
    *("colors", "extinctions", "positions", "values", "points"),
    *("eye", "target", "fov", "origins", "directions"),
)
SIDE = 6
STEPS = 128
# Errors are relative to the gradient, or to this share of the loss where that is more: a gradient
# that is zero by cancellation of terms as large as the loss (origins moved sideways in a constant
# field) has no digits of its own.
ZERO = 1e-3


def make_mesh(location: str, dtype: str) -> Any:
    """A box of 3 x 3 x 3 blocks, 162 tetrahedra, with data at points, cells or corners."""
    mesh = datasets.box((3, 3, 3), jitter=0.2, seed=1, dtype=dtype)
    corner = np.asarray(mesh.values)[np.asarray(mesh.cells)]
    if location == "cell":
        return mesh.replace(values=corner.mean(1), location="cell")
    if location == "corner":
        bump = 0.05 * np.sin(np.arange(corner.size).reshape(corner.shape))
        return mesh.replace(values=corner + bump, location="corner")
    return mesh


def make_parameters(mesh: Any, depth: float = 3.0) -> dict[str, np.ndarray]:
    """Float64 arrays, by class. The box has size 1 and is seen from its front."""
    rng = np.random.default_rng(5)
    extinctions = 0.3 + rng.random(11)
    return {
        "colors": rng.random((11, 3)),
        "extinctions": extinctions * depth / extinctions.mean(),
        "positions": np.linspace(0.03, 0.93, 11) + 0.02 * rng.random(11),
        "values": np.asarray(mesh.values, np.float64),
        "points": np.asarray(mesh.points, np.float64),
        "eye": np.array([0.62, 0.45, 2.6]),
        "target": np.array([0.48, 0.53, 0.5]),
        "fov": np.array(12.0),
        "origins": np.zeros((SIDE, SIDE, 3)),
        "directions": np.zeros((SIDE, SIDE, 3)),
    }


@functools.cache
def losses(location: str, dtype: str) -> dict[str, Callable]:
    """Compiled: `value(p)`, `replay(p)` and `direct(p)` (gradients), `forward(p, v)` (tangent)."""
    mesh = make_mesh(location, dtype)
    rng = np.random.default_rng(9)
    weight = jnp.asarray(rng.random((SIDE, SIDE, 4)), dtype)
    goal = jnp.asarray(rng.random((SIDE, SIDE, 4)), dtype)
    camera = jaxvr.Camera.look_at((0, 0, 3), (0, 0, 0), fov=12.0, width=SIDE, height=SIDE)

    def loss(p, adjoint):
        p = {k: jnp.asarray(x, dtype) for k, x in p.items()}
        view = dataclasses.replace(camera, eye=p["eye"], target=p["target"], fov=p["fov"])
        view = jax.tree.map(lambda x: jnp.asarray(x, dtype), view)
        origins, directions = view.rays()
        tf = jaxvr.TransferFunction(p["positions"], p["colors"], p["extinctions"])
        volume = mesh.replace(points=p["points"], values=p["values"])
        rgba, status = jaxvr.render_rays(
            volume,
            origins + p["origins"],
            directions + p["directions"],
            tf,
            adjoint=adjoint,
            status=True,
        )
        return jnp.sum(weight * (rgba - goal) ** 2), status

    replay = jax.jit(jax.value_and_grad(lambda p: loss(p, jaxvr.Replay()), has_aux=True))
    direct = jax.jit(
        jax.value_and_grad(lambda p: loss(p, jaxvr.Direct(max_steps=STEPS)), has_aux=True)
    )

    def forward(p, v):
        return jax.jvp(lambda p: loss(p, jaxvr.Forward())[0], (p,), (v,))[1]

    value = jax.jit(lambda p: loss(p, jaxvr.Replay()))

    def checked(function):
        def call(p):
            (_, status), gradient = function(p)
            jaxvr.check(status)
            return {k: np.asarray(x, np.float64) for k, x in gradient.items()}

        return call

    return {
        "value": lambda p: float(value(p)[0]),
        "replay": checked(replay),
        "direct": checked(direct),
        "forward": jax.jit(forward),
    }


def difference(
    value: Callable, p: dict[str, Any], v: dict[str, Any], step: float, one_sided: bool
) -> tuple[float, float]:
    """Derivative of `value` at `p` along `v`, and an estimate of its error."""

    def at(h: float) -> float:
        return value({k: x + h * v[k] if k in v else x for k, x in p.items()})

    steps = [step / 2**i for i in range(8)]
    if one_sided:
        f = {h: at(h) for h in [*steps, 0.0]}
        base = f[0.0]
        first = np.array([(f[h] - base) / h for h in steps])
        second = 2 * first[1:] - first[:-1]  # removes the error of order h, then h^2 and h^3
        third = (4 * second[1:] - second[:-1]) / 3
        best = (8 * third[1:] - third[:-1]) / 7
    else:
        first = np.array([(at(h) - at(-h)) / (2 * h) for h in steps])
        second = (4 * first[1:] - first[:-1]) / 3
        best = (16 * second[1:] - second[:-1]) / 15
    apart = np.abs(np.diff(best))
    i = int(apart.argmin())
    return float(best[i + 1]), float(apart[i])


def directions_of(name: str, p: dict[str, np.ndarray], rng: np.random.Generator, jump: bool):
    """A random direction of change in one class, of about the parameters' own scale."""
    v = rng.normal(size=p[name].shape)
    if name == "extinctions":
        v = v * np.where(p[name] > 0, p[name], 1.0)
    if name in ("positions", "values"):
        v = 0.1 * v
    if name in ("points", "eye", "target", "origins", "directions"):
        v = 0.02 * v
    if name == "fov":
        v = np.ones_like(v)  # degrees: a step of 4e-3 moves rays by 1e-4
    if name == "positions" and jump:
        v[8] = v[7]
    return {name: v}


def check(
    location: str,
    p: dict[str, np.ndarray],
    classes: tuple[str, ...] = CLASSES,
    *,
    jump: bool = False,
    one_sided: tuple[str, ...] = (),
    repeats: int = 2,
    step: float = 4e-3,
    adjoints: bool = True,
) -> dict[str, dict[str, float]]:
    """Relative errors by class: `difference` (of Replay from differences), `estimate` (of the
    differences' own error), `direct` (largest |Direct - Replay| of the largest entry), `forward`
    (of the tangent from Replay's), and `size` (of the gradient)."""
    f = losses(location, "float64")
    gradient = f["replay"](p)
    direct = f["direct"](p) if adjoints else None
    rng = np.random.default_rng(2)
    out = {}
    for name in classes:
        worst = {"difference": 0.0, "estimate": 0.0, "forward": 0.0}
        for _ in range(repeats):
            v = directions_of(name, p, rng, jump)
            if name in one_sided:
                v = {k: np.abs(x) for k, x in v.items()}
            along = float(np.sum(gradient[name] * v[name]))
            # cancellation between the entries of a direction is no error of the gradient
            size = float(np.linalg.norm(gradient[name]) * np.linalg.norm(v[name]))
            size = max(abs(along), size / np.sqrt(gradient[name].size))
            size = max(size, ZERO * abs(f["value"](p)))
            found, estimate = difference(f["value"], p, v, step, name in one_sided)
            worst["difference"] = max(worst["difference"], abs(along - found) / size)
            worst["estimate"] = max(worst["estimate"], estimate / size)
            if adjoints:
                whole = {k: v.get(k, np.zeros_like(x)) for k, x in p.items()}
                tangent = float(f["forward"](p, whole))
                worst["forward"] = max(worst["forward"], abs(along - tangent) / size)
        largest = float(np.abs(gradient[name]).max())
        if direct is not None:
            gap = np.abs(direct[name] - gradient[name]).max()
            worst["direct"] = float(gap / max(largest, ZERO * abs(f["value"](p))))
        worst["size"] = largest
        worst["finite"] = float(np.isfinite(gradient[name]).all())
        out[name] = worst
    return out


def single_precision(location: str, p: dict[str, np.ndarray]) -> dict[str, float]:
    """Largest difference between float32 and float64 gradients, of the largest entry, by class;
    both at parameters rounded to float32."""
    p = {k: x.astype(np.float32).astype(np.float64) for k, x in p.items()}
    double = losses(location, "float64")["replay"](p)
    single = losses(location, "float32")["replay"]({k: x.astype(np.float32) for k, x in p.items()})
    return {
        k: float(np.abs(single[k] - double[k]).max() / np.abs(double[k]).max()) for k in CLASSES
    }


Case = tuple[dict[str, np.ndarray], dict[str, Any]]


def cases(location: str) -> dict[str, Case]:
    """Parameters and keywords of `check` for the plain case and the hard ones."""
    mesh = make_mesh(location, "float64")
    plain = make_parameters(mesh)
    out: dict[str, Case] = {"plain": (plain, {})}

    inside = {**plain, "eye": np.array([0.52, 0.47, 0.71]), "target": np.array([0.4, 0.6, 0.1])}
    out["eye inside"] = ({**inside, "fov": np.array(25.0)}, {})

    jump = {**plain, "positions": plain["positions"].copy()}
    jump["positions"][8] = jump["positions"][7]
    out["jump"] = (jump, {"jump": True})

    zero = {**plain, "extinctions": np.zeros(11)}
    out["extinction 0"] = (zero, {"one_sided": ("extinctions",)})

    constant = {**plain, "values": np.full_like(plain["values"], 0.4321)}
    out["constant field"] = (constant, {})

    # one cell of optical depth 1e4: a scalar of its own, or a steep peak where data are at points
    thick = {k: x.copy() for k, x in plain.items()}
    if location == "point":
        thick["extinctions"][5] = 1e5
        out["depth 1e4"] = (thick, {"classes": ("colors", "extinctions"), "step": 1e-3})
    else:
        cell = len(thick["values"]) // 2
        thick["values"][cell] = 2.0
        thick["positions"][9:] = (1.4, 1.5)
        thick["extinctions"][10] = 1e5
        out["depth 1e4"] = (thick, {"step": 1e-4})

    if location == "point":
        vertex = {**plain, "positions": plain["positions"].copy()}
        middle = np.argmin(np.linalg.norm(plain["points"] - 0.45, axis=1))
        k = int(np.argmin(np.abs(vertex["positions"] - plain["values"][middle])))
        vertex["positions"][k] = plain["values"][middle]
        out["point at vertex value"] = (vertex, {})
    return out


def main(arguments: Any = None) -> list[dict[str, Any]]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    places = ["point", "cell", "corner"]
    parser.add_argument("--locations", nargs="+", default=places, choices=places)
    parser.add_argument("--tiny", action="store_true", help="point data, the plain case")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    results = []
    print("relative errors of Replay's gradient: from differences (and their own estimate), from")
    print("Direct's, from Forward's tangent")
    for location in ["point"] if options.tiny else options.locations:
        for case, (p, keywords) in cases(location).items():
            if options.tiny and case != "plain":
                continue
            for name, r in check(location, p, **keywords).items():
                results.append({"location": location, "case": case, "class": name, **r})
                print(
                    f"{location:7}{case:22}{name:12}{r['difference']:9.1e}{r['estimate']:9.1e}"
                    f"{r.get('direct', 0):9.1e}{r['forward']:9.1e}"
                    f"{'' if r['finite'] else '  NOT FINITE'}",
                    flush=True,
                )
        if not options.tiny:
            deep = make_parameters(make_mesh(location, "float64"), depth=11.0)
            single = single_precision(location, deep)
            results.append({"location": location, "case": "float32", **single})
            text = " ".join(f"{k} {x:.1e}" for k, x in single.items())
            print(f"{location:7}float32 against float64 at optical depth 11: {text}", flush=True)
    if options.json:
        options.json.write_text(json.dumps(results, indent=1) + "\n")
    return results


if __name__ == "__main__":
    main()
