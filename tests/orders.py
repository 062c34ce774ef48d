"""Gradients by classes of operands, in any order in one process, pullbacks alive at once.

JAX keeps what it has traced for the life of a process, and a rule of a `custom_vjp` may leave in it
what a later gradient reads. So a gradient is a function of its operands *and* of the history of
the process, unless a test says that it is not: `alone` makes each gradient with caches cleared,
programs make them in company, and all must agree. Clearing the caches before a program is part of
it: a pattern that has been compiled once is no longer traced, and hides the fault.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import jax
import numpy as np

import jaxvr

OPERANDS = ("colors", "extinctions", "positions", "values", "points", "eye")
PATTERNS = {name: (name,) for name in OPERANDS} | {"all": OPERANDS}
NAMES = tuple(PATTERNS)
Bits = tuple[bytes, ...]
T = TypeVar("T")
# A name makes a pullback by that pattern, a number i calls the one made as the i-th.
Program = Sequence[str | int]


class Scene:
    """A small picture, and pullbacks of it by some of its operands.

    native: True takes loops in C, False JAX's own, None what is taken by default.
    """

    def __init__(self, dtype: str, native: bool | None):
        mesh = jaxvr.datasets.box((1, 1, 1), dtype=dtype, field=lambda p: p[:, 0] + 0.2 * p[:, 1])
        self.mesh = mesh
        self.camera = jaxvr.Camera.orbit(mesh, azimuth=31, elevation=17, width=4, height=4)
        colors = np.array([[0.1, 0.2, 1], [0.2, 1, 0.1], [1, 0.3, 0.2]])
        self.transfer = jaxvr.TransferFunction(
            np.array([0.05, 0.37, 1.1]), colors, np.array([0.5, 2.0, 4.0]), dtype=dtype
        )
        self.engine = None if native is None else jaxvr.engine.C() if native else jaxvr.engine.XLA()
        rng = np.random.default_rng(3)
        self.cotangent = rng.uniform(0.5, 1.5, (4, 4, 4)).astype(dtype)

    def operand(self, name: str) -> jax.Array:
        if name in ("values", "points"):
            return getattr(self.mesh, name)
        return self.camera.eye if name == "eye" else getattr(self.transfer, name)

    def image(self, **operands: jax.Array) -> jax.Array:
        """The picture with some operands replaced."""
        of = {k: {n: operands[n] for n in names if n in operands} for k, names in _OWNERS.items()}
        return jaxvr.render(
            self.mesh.replace(**of["mesh"]),
            self.camera.replace(**of["camera"]),
            self.transfer.replace(**of["transfer"]),
            engine=self.engine,
        )

    def pullback(self, pattern: str):
        """The pullback by the operands of a pattern: a function without arguments to their bits."""
        names = PATTERNS[pattern]
        _, pull = jax.vjp(
            lambda *xs: self.image(**dict(zip(names, xs, strict=True))), *map(self.operand, names)
        )
        return lambda: tuple(np.asarray(x).tobytes() for x in pull(self.cotangent))

    def run(self, steps: Program) -> dict[int, Bits]:
        """The gradients of a program: what the pullback made as the i-th gives, by i."""
        jax.clear_caches()
        pullbacks: list[Any] = []
        found = {}
        for step in steps:
            if isinstance(step, str):
                pullbacks.append(self.pullback(step))
            else:
                found[step] = pullbacks[step]()
        return found

    def trace(self, steps: Program) -> dict[int, str]:
        """As `run`, but what the pullbacks would compute, as text: nothing is compiled, which takes
        nearly all of the time. What is computed differs where what would be computed does."""
        jax.clear_caches()
        found: dict[int, str] = {}

        def outer(operands, cotangent):
            pullbacks: list[Any] = []
            for step in steps:
                if isinstance(step, str):
                    chosen = {n: operands[n] for n in PATTERNS[step]}
                    pullbacks.append(jax.vjp(lambda xs: self.image(**xs), chosen)[1])
                else:
                    text = str(jax.make_jaxpr(pullbacks[step])(cotangent).jaxpr)
                    found[step] = re.sub(r" at 0x[0-9a-f]+", "", text)
            return ()

        jax.make_jaxpr(outer)({n: self.operand(n) for n in OPERANDS}, self.cotangent)
        return found


_OWNERS = {
    "mesh": ("values", "points"),
    "camera": ("eye",),
    "transfer": ("colors", "extinctions", "positions"),
}


def alone(how: Callable[[Program], dict[int, T]], names: Sequence[str] = NAMES) -> dict[str, T]:
    """What patterns give as the first of a process. how: a scene's `run` or `trace`."""
    return {name: how([name, 0])[0] for name in names}


def wrong(steps: Program, found: dict[int, T], alone: dict[str, T]) -> list[str]:
    """The gradients of a program that differ from what they are alone."""
    made = [s for s in steps if isinstance(s, str)]
    return [f"{made[i]} (made as number {i})" for i, x in found.items() if x != alone[made[i]]]


def pairs() -> Iterator[Program]:
    """Two pullbacks made, then called: all ordered pairs, a pattern with itself included."""
    for a, b in itertools.product(NAMES, NAMES):
        yield [a, b, 0, 1]


def sequences(count: int, seed: int = 0) -> Iterator[Program]:
    """Six pullbacks at random, each called at a random moment after it was made."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        made = [NAMES[i] for i in rng.integers(len(NAMES), size=6)]
        steps: list[str | int] = []
        waiting: list[int] = []
        for i, name in enumerate(made):
            steps.append(name)
            waiting.append(i)
            while waiting and rng.random() < 0.35:
                steps.append(waiting.pop(int(rng.integers(len(waiting)))))
        yield steps + [waiting[i] for i in rng.permutation(len(waiting))]
