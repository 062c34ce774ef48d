"""Every integrator: what it costs, what it errs by, and how wrong its gradients are.

    python -m experiments.integrators bluntfin.vtu oxygen_post.vtu --vectors FILE.npz [--size 512]

Segments of one view are traced once, then shaded by each integrator in turn; the medians of turns
taken in one run are compared, so that the ratios to `Analytic` hold on a noisy machine. Truth is
`Analytic` in float64 on the same segments. Reference values of single slabs are read from an .npz
of inputs (tau_f, tau_b, l, C_f, C_b) and results (rgb, alpha), where one is given.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

import jaxvr
from experiments.common import with_x64, write_json
from experiments.speed import camera_of, median_of, transfer_of

# How many batches of rays one timing of slabs runs through, and of how many rays each.
LANES = (2048, 512)


# Whole renders are timed for those that one might choose.
RENDERED = (
    "Analytic()",
    'Analytic("fast")',
    'Analytic("draft")',
    "PartialPreIntegration(128)",
    '... 512, "bilinear"',
    "PreIntegration()",
    "AverageColor()",
)


def contestants() -> dict[str, Any]:
    """Integrators by the name that the tables show."""
    return {
        "Analytic()": jaxvr.Analytic(),
        'Analytic("fast")': jaxvr.Analytic("fast"),
        'Analytic("draft")': jaxvr.Analytic("draft"),
        "PartialPreIntegration(64)": jaxvr.PartialPreIntegration(64),
        "PartialPreIntegration(128)": jaxvr.PartialPreIntegration(128),
        "PartialPreIntegration(512)": jaxvr.PartialPreIntegration(512),
        '... crossings="texture"': jaxvr.PartialPreIntegration(128, crossings="texture"),
        '... 512, "bilinear"': jaxvr.PartialPreIntegration(512, "bilinear"),
        '... 512, "nearest"': jaxvr.PartialPreIntegration(512, "nearest"),
        "PreIntegration()": jaxvr.PreIntegration(),
        '... scale="log"': jaxvr.PreIntegration(scale="log"),
        "... bits=16": jaxvr.PreIntegration(bits=16),
        "... bits=8": jaxvr.PreIntegration(bits=8),
        "Quadrature(samples=4)": jaxvr.Quadrature(samples=4),
        "Quadrature(samples=16)": jaxvr.Quadrature(samples=16),
        'Quadrature("trapezoid", 8)': jaxvr.Quadrature("trapezoid", 8),
        'Quadrature("riemann", 8)': jaxvr.Quadrature("riemann", 8),
        "ConstantExtinction()": jaxvr.ConstantExtinction(),
        "AverageColor()": jaxvr.AverageColor(),
    }


def slab_errors(integrators: dict[str, Any], vectors: Any) -> dict[str, float]:
    """Largest error of rgb over the largest colour, or of alpha, in float32, on slabs whose inputs
    are float32 numbers."""
    exact = np.asarray(vectors["f32_exact_inputs"])
    inputs = [
        np.float32(vectors[k][exact]) for k in ("tau_f", "tau_b", "C_f", "C_b", "l")
    ]  # fmt: skip
    largest = np.maximum(np.abs(inputs[2]), np.abs(inputs[3])).max(1)
    errors = {}
    for name, integrator in integrators.items():
        rgb, alpha = (np.float64(x) for x in integrator.slab(*inputs))
        of_color = np.abs(rgb - vectors["rgb"][exact]).max(1) / np.maximum(largest, 1e-30)
        of_alpha = np.abs(alpha - vectors["alpha"][exact])
        errors[name] = float(max(of_color.max(), of_alpha.max()))
    return errors


def slab_seconds(
    integrators: dict[str, Any], repeat: int, lanes: tuple[int, int] = LANES
) -> dict[str, dict[str, float]]:
    """Nanoseconds for the weights of one slab, and with their derivatives, where there are any."""
    rng = np.random.default_rng(0)
    a, b = (jnp.asarray(rng.exponential(1, lanes), jnp.float32) for _ in range(2))

    def in_batches(f):
        return jax.jit(lambda a, b: lax.map(lambda x: f(*x), (a, b)))

    tasks: dict[str, Callable[[], Any]] = {}
    for name, integrator in integrators.items():
        if not hasattr(integrator, "weights"):
            continue
        value = in_batches(integrator.weights)
        slope = in_batches(
            lambda a, b, w=integrator.weights: jax.vjp(w, a, b)[1]((jnp.ones_like(a), b))
        )
        tasks[name] = lambda f=value: f(a, b)
        tasks[name + "'"] = lambda f=slope: f(a, b)
    seconds = median_of(tasks, repeat, quiet=True)
    per = 1e9 / a.size
    return {
        name: {"slab_ns": seconds[name] * per, "slab_gradient_ns": seconds[name + "'"] * per}
        for name in integrators
        if name in seconds
    }


def shading(integrator: Any):
    """A function of (transfer, scalar, segments, weights): the image, and the gradients of its
    weighted sum with respect to the first two; `scalar` takes the place of that of `segments`."""

    def loss(transfer, scalar, segments, weights):
        image = jaxvr.shade(
            dataclasses.replace(segments, scalar=scalar), transfer, integrator=integrator
        )
        return jnp.sum(image * weights), image

    return jax.jit(jax.value_and_grad(loss, (0, 1), has_aux=True))


def truth_of(segments: jaxvr.Segments, transfer: Any, weights: np.ndarray):
    """Image and gradients by `Analytic` in float64."""
    with with_x64():
        double = dataclasses.replace(
            segments,
            scalar=jnp.asarray(np.asarray(segments.scalar), jnp.float64),
            length=jnp.asarray(np.asarray(segments.length), jnp.float64),
        )
        transfer = transfer.astype("float64")
        (_, image), bars = shading(jaxvr.Analytic())(
            transfer, double.scalar, double, jnp.asarray(weights, jnp.float64)
        )
        return np.asarray(image), jax.tree.map(np.asarray, bars)


def apart(found: Any, true: Any) -> float:
    """Norm of the difference over the norm of the truth."""
    found, true = np.float64(found), np.float64(true)
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))


def on_image(
    mesh: jaxvr.TetMesh, integrators: dict[str, Any], size: int, repeat: int
) -> dict[str, dict[str, float]]:
    """Errors, gradients and seconds of whole images of one mesh."""
    camera, transfer = camera_of(mesh, size), transfer_of(mesh)
    segments = jaxvr.trace(mesh, camera)
    weights = np.random.default_rng(1).normal(size=(size, size, 4)).astype(np.float32)
    image, bars = truth_of(segments, transfer, weights)
    rows: dict[str, dict[str, float]] = {}
    tasks: dict[str, Callable[[], Any]] = {}
    for name, integrator in integrators.items():
        gradient = shading(integrator)
        (_, found), slopes = gradient(transfer, segments.scalar, segments, weights)
        table = jax.jit(lambda t, i=integrator: i.prepare(t, jnp.float32, jnp.float32(1)))
        rows[name] = {
            "error": float(np.abs(found - image).max()),
            "mean_error": float(np.abs(found - image).mean()),
            "colors": apart(slopes[0].colors, bars[0].colors),
            "extinctions": apart(slopes[0].extinctions, bars[0].extinctions),
            "positions": apart(slopes[0].positions, bars[0].positions),
            "scalars": apart(slopes[1], bars[1]),
            "table_bytes": sum(x.nbytes for x in jax.tree.leaves(table(transfer)))
            + constant_bytes(integrator),
        }
        shade = jax.jit(lambda t, s, i=integrator: jaxvr.shade(s, t, integrator=i))
        tasks[f"{name}|build"] = lambda f=table: f(transfer)
        tasks[f"{name}|shade"] = lambda f=shade: f(transfer, segments)
        tasks[f"{name}|gradient"] = lambda f=gradient: f(
            transfer, segments.scalar, segments, weights
        )
        if name in RENDERED:
            tasks[f"{name}|render"] = lambda i=integrator: jaxvr.render(
                mesh, camera, transfer, integrator=i
            )
    for key, seconds in median_of(tasks, repeat, quiet=True).items():
        name, what = key.split("|")
        rows[name][f"{what}_s"] = seconds
    return rows


def constant_bytes(integrator: Any) -> int:
    """Of the table that does not depend on the transfer function."""
    if not isinstance(integrator, jaxvr.PartialPreIntegration):
        return 0
    size = integrator.table_size
    return 8 * (size + 2) ** 2 if integrator.lookup == "bicubic" else 4 * size**2


def run(
    meshes: dict[str, jaxvr.TetMesh],
    size: int,
    repeat: int,
    vectors: Any = None,
    integrators: dict[str, Any] | None = None,
    lanes: tuple[int, int] = LANES,
) -> dict[str, Any]:
    """All numbers: {"slab": {integrator: ...}, mesh: {integrator: ...}}; prints the tables.

    vectors: reference values of slabs. integrators: by name, with "Analytic()" among them; None
    for all `contestants`.
    """
    integrators = integrators or contestants()
    slab: dict[str, dict[str, float]] = {name: {} for name in integrators}
    if vectors is not None:
        for name, error in slab_errors(integrators, vectors).items():
            slab[name]["error"] = error
    for name, seconds in slab_seconds(integrators, repeat, lanes).items():
        slab[name].update(seconds)
    result: dict[str, Any] = {"slab": slab}
    for title, mesh in meshes.items():
        result[title] = on_image(mesh, integrators, size, repeat)
        print(f"\n{title}, {mesh.n_tets:,} tets, {size} x {size}\n", flush=True)
        print_table(slab, result[title])
    return result


def print_table(slab: dict[str, Any], rows: dict[str, Any]) -> None:
    """Markdown; times as ratios to `Analytic`."""
    base_slab, base = slab["Analytic()"], rows["Analytic()"]

    def number(x: float | None, form: str = ".1e") -> str:
        return "-" if x is None else format(x, form)

    def times(row, base, key):
        return number(row[key] / base[key] if key in row else None, ".2f")

    print(
        "| integrator | slab | with derivative | shade | with gradients | render | table KB "
        "| build ms | slab error | image, max | mean | d colours | d extinctions | d positions "
        "| d scalars |"
    )
    print("|---|" + "---|" * 14)
    for name, row in rows.items():
        own = slab[name]
        cells = [
            times(own, base_slab, "slab_ns"),
            times(own, base_slab, "slab_gradient_ns"),
            times(row, base, "shade_s"),
            times(row, base, "gradient_s"),
            times(row, base, "render_s"),
            number(row["table_bytes"] / 1e3, ".0f"),
            number(row["build_s"] * 1e3, ".1f"),
            number(own.get("error")),
            *(number(row[k]) for k in ("error", "mean_error")),
            *(number(row[k]) for k in ("colors", "extinctions", "positions", "scalars")),
        ]
        print(f"| `{name}` | " + " | ".join(cells) + " |", flush=True)
    print(
        f"\n1.00 is {base_slab['slab_ns']:.1f} ns a slab, {base_slab['slab_gradient_ns']:.1f} ns "
        f"with derivative, {base['shade_s']:.3f} s to shade, {base['gradient_s']:.3f} s "
        "with gradients"
        + (f", {base['render_s']:.3f} s to render." if "render_s" in base else "."),
        flush=True,
    )


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description="integrators: cost, error, gradients")
    parser.add_argument("meshes", nargs="+", type=Path)
    parser.add_argument("--size", type=int, default=512)
    parser.add_argument("--repeat", type=int, default=5)
    parser.add_argument("--vectors", type=Path)
    parser.add_argument("--json")
    options = parser.parse_args(arguments)
    meshes = {p.stem: jaxvr.read_mesh(p, dtype="float32") for p in options.meshes}
    vectors = None if options.vectors is None else np.load(options.vectors)
    result = run(meshes, options.size, options.repeat, vectors)
    if options.json:
        write_json(options.json, result)
    return result


if __name__ == "__main__":
    main()
