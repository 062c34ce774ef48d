"""Over which units pictures keep their bits.

    python -m experiments.units [--size 48] [--json FILE] [--tiny]

Pictures are rendered with scalars (values and positions of control points), lengths (points, eye,
target, extent) and with them extinctions (one over a length) times powers of two, up and down, and
compared with the picture in the units given: all bits, in both precisions, by compiled loops and
JAX's own, from a pinhole and with parallel rays, by `render` and by `shade`. The gradients of a
weighted sum by values, points, positions, colours, extinctions, eye and target are compared too,
each times its own power of two. Told is the range of exponents without a gap where all bits are the
same, and what pictures outside of it are: an error in words, a gradient that is NaN by what is out
of range, or a picture that is wrong. What `jaxvr.units` states is to be found.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxvr
from experiments.common import table

# Beyond the exponents of subnormal and of the largest numbers.
REACH = {"float32": 152, "float64": 1078}
# What the numbers of each are multiplied with, as powers of the scalar's and of the length's unit.
POWERS = {
    "values": (1, 0),
    "points": (0, 1),
    "positions": (1, 0),
    "colors": (0, 0),
    "extinctions": (0, -1),
    "eye": (0, 1),
    "target": (0, 1),
}


@dataclasses.dataclass
class Setting:
    """A jittered box across two jumps, and the numbers of its picture in other units."""

    dtype: str
    parallel: bool = False
    blocks: tuple[int, int, int] = (4, 3, 3)
    width: int = 48
    height: int = 48

    def __post_init__(self):
        rng = np.random.default_rng(0)
        self.mesh = jaxvr.datasets.box(
            self.blocks,
            jitter=0.2,
            seed=1,
            dtype=self.dtype,
            field=lambda p: p[:, 0] + 0.4 * np.sin(3 * p[:, 1]) - 0.3 * p[:, 2],
        )
        numbers = {
            "values": self.mesh.values,
            "points": self.mesh.points,
            "positions": [-0.1, 0.1, 0.4, 0.4, 0.9, 0.9],
            "colors": rng.uniform(0, 1, (6, 3)),
            "extinctions": rng.uniform(0.3, 6, 6),
            "eye": [1.9, 1.4, 2.3],
            "target": [0.5, 0.5, 0.5],
            "size": 1.5 if self.parallel else 32.0,  # extent, a length, or fov
        }
        self.numbers = {k: np.asarray(x, self.dtype) for k, x in numbers.items()}

    def power(self, name: str, scalar: int, length: int) -> int:
        """The power of two that numbers of a name are multiplied with, where scalars are with
        2^scalar and lengths are with 2^length."""
        of_scalar, of_length = POWERS.get(name, (0, int(self.parallel)))
        return of_scalar * scalar + of_length * length

    def scaled(self, scalar: int = 0, length: int = 0) -> dict[str, np.ndarray]:
        return {k: np.ldexp(x, self.power(k, scalar, length)) for k, x in self.numbers.items()}

    def parts(self, numbers: dict[str, Any]) -> tuple[Any, Any, Any]:
        """Volume, camera and transfer function, unchecked, so that it works under jit."""
        n = {k: jnp.asarray(x) for k, x in numbers.items()}
        view = {"width": self.width, "height": self.height, "dtype": self.dtype}
        camera = jaxvr.Camera.look_at((0, 0, 1), (0, 0, 0), **view)
        camera = dataclasses.replace(
            camera,
            eye=n["eye"],
            target=n["target"],
            fov=None if self.parallel else n["size"],
            extent=n["size"] if self.parallel else None,
        )
        transfer = jaxvr.TransferFunction([0.0], [[0, 0, 0]], [0.0], dtype=self.dtype)
        fields = {k: n[k] for k in ("positions", "colors", "extinctions")}
        mesh = dataclasses.replace(self.mesh, values=n["values"], points=n["points"])
        return mesh, camera, dataclasses.replace(transfer, **fields)

    def render(self, numbers: dict[str, Any], **nouns: Any) -> Any:
        return jaxvr.render(*self.parts(numbers), **nouns)


class Picture:
    """What is looked at in each unit: pictures and gradients of a setting, as lists of arrays."""

    def __init__(self, dtype: str, size: int, parallel: bool = False, native: bool = True):
        self.setting = Setting(dtype, parallel, width=size, height=size)
        self.engine = jaxvr.engine.C() if native else jaxvr.engine.XLA()
        weights = np.random.default_rng(1).normal(size=(size, size, 4)).astype(dtype)
        self.slopes = jax.jit(jax.grad(lambda numbers: (self.image(numbers) * weights).sum()))

    def image(self, numbers: dict[str, Any]) -> Any:
        return self.setting.render(numbers, engine=self.engine)

    def render(self, scalar: int, length: int) -> list[np.ndarray]:
        return [np.asarray(self.image(self.setting.scaled(scalar, length)))]

    def shade(self, scalar: int, length: int) -> list[np.ndarray]:
        mesh, camera, transfer = self.setting.parts(self.setting.scaled(scalar, length))
        segments = jaxvr.trace(mesh, camera, engine=self.engine)
        return [np.asarray(jaxvr.shade(segments, transfer, engine=self.engine))]

    def gradient(self, scalar: int, length: int) -> list[np.ndarray]:
        numbers = self.setting.scaled(scalar, length)
        self.image(numbers)  # tells what is out of range
        slopes = self.slopes(numbers)
        power = self.setting.power
        return [np.ldexp(np.asarray(x), power(k, scalar, length)) for k, x in slopes.items()]


def attempt(make: Any, want: list[np.ndarray], scalar: int, length: int) -> str:
    """What became of it: the same bits, the error's name, or how far off the picture is."""
    try:
        got = make(scalar, length)
    except (jaxvr.RenderError, ValueError) as error:
        return type(error).__name__
    if all(np.array_equal(a, b) for a, b in zip(got, want, strict=True)):
        return "same bits"
    if any(np.isnan(a).any() for a in got):
        return "NaN"
    off = max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in zip(got, want, strict=True))
    return f"off by {off:.1g}"


def span(make: Any, unit: str, reach: int, step: int) -> dict[str, Any]:
    """The exponents, from 0 outwards, where all bits are the same, and what comes beyond. Tried are
    multiples of `step`, and every one between the last with the same bits and the first without."""
    want = make(0, 0)
    row: dict[str, Any] = {}
    for side, sign in (("from", -1), ("to", 1)):
        row[side], outside = 0, []

        def at(k, sign=sign):
            return attempt(make, want, *((sign * k, 0) if unit == "scalar" else (0, sign * k)))

        for k in range(step, reach, step):
            found = at(k)
            if found == "same bits" and not outside:
                row[side] = sign * k
            elif not outside or outside[-1] != found:
                outside.append(found)
            if outside and k - abs(row[side]) == step:
                for between in range(k - step + 1, k):
                    if (found := at(between)) != "same bits":
                        outside = [found, *(x for x in outside if x != found)]
                        break
                    row[side] = sign * between
        row[f"beyond {side}"] = ", ".join(outside) or "-"
    return row


def run(
    size: int = 48, steps: dict[str, int] | None = None, parallel: bool = True
) -> dict[str, Any]:
    """steps: see `span`, by dtype."""
    rows = []
    for dtype in ("float32", "float64"):
        step = (steps or {"float32": 8, "float64": 32})[dtype]
        settings = [(False, True), (False, False), *([(True, True)] if parallel else [])]
        for rays, native in settings:
            picture = Picture(dtype, size, rays, native)
            what = {"render": picture.render}
            if native and not rays:
                what |= {"shade(trace)": picture.shade, "gradients": picture.gradient}
            for name, make in what.items():
                for unit in ("scalar", "length"):
                    row = {
                        "dtype": dtype,
                        "what": name,
                        "loops": "compiled" if native else "JAX",
                        "rays": "parallel" if rays else "pinhole",
                        "unit": unit,
                    }
                    rows.append(row | span(make, unit, REACH[dtype], step))
                    print(rows[-1], flush=True)
    print(table(rows), flush=True)
    return {"size": size, "rows": rows}


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=int, default=48)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--tiny", action="store_true")
    args = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore", jaxvr.ViewWarning)
        if args.tiny:
            report = run(6, {"float32": 33, "float64": 319}, parallel=False)
        else:
            report = run(args.size)
    if args.json:
        args.json.write_text(json.dumps(report, indent=1) + "\n")
    return report


if __name__ == "__main__":
    main()
