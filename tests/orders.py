"""Gradients by classes of operands, in any order in one process, pullbacks alive at once.

JAX keeps what it has traced for the life of a process, and a rule of a `custom_vjp` may leave in it
what a later gradient reads. So a gradient is a function of its operands *and* of the history of
the process, unless a test says that it is not: `alone` makes each gradient with caches cleared, the
other functions make them in company, and all must agree to the bit. Clearing the caches before an
order is part of it: a pattern that has been compiled once is no longer traced, and hides the fault.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from typing import TypeVar

import jax
import numpy as np

import jaxvr

OPERANDS = ("colors", "extinctions", "positions", "values", "points", "eye")
PATTERNS = {name: (name,) for name in OPERANDS} | {"all": OPERANDS}
NAMES = tuple(PATTERNS)
Bits = tuple[bytes, ...]
T = TypeVar("T")


class Scene:
    """A small picture, and pullbacks of it by some of its operands.

    native: as for `jaxvr.Replay`; False takes JAX's own loops.
    """

    def __init__(self, dtype: str, native: bool | None):
        mesh = jaxvr.datasets.box((1, 1, 1), dtype=dtype, field=lambda p: p[:, 0] + 0.2 * p[:, 1])
        self.mesh = mesh
        self.camera = jaxvr.Camera.orbit(mesh, azimuth=31, elevation=17, width=4, height=4)
        colors = np.array([[0.1, 0.2, 1], [0.2, 1, 0.1], [1, 0.3, 0.2]])
        self.transfer = jaxvr.TransferFunction(
            np.array([0.05, 0.37, 1.1]), colors, np.array([0.5, 2.0, 4.0]), dtype=dtype
        )
        self.adjoint = jaxvr.Replay(native=native)
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
            adjoint=self.adjoint,
        )

    def pullback(self, pattern: str):
        """The pullback by the operands of a pattern: a function without arguments to their bits."""
        names = PATTERNS[pattern]
        _, pull = jax.vjp(
            lambda *xs: self.image(**dict(zip(names, xs, strict=True))), *map(self.operand, names)
        )
        return lambda: tuple(np.asarray(x).tobytes() for x in pull(self.cotangent))

    def alone(self) -> dict[str, Bits]:
        """Each pattern's gradient, as the first of a process."""
        found = {}
        for name in NAMES:
            jax.clear_caches()
            found[name] = self.pullback(name)()
        return found

    def interleaved(self, made: Sequence[str], called: Sequence[int]) -> list[Bits]:
        """Pullbacks made in one order, and called in another: number called[i] as the i-th.
        Returns the gradients in the order in which they were made."""
        jax.clear_caches()
        pullbacks = [self.pullback(name) for name in made]
        found: dict[int, Bits] = {i: pullbacks[i]() for i in called}
        return [found[i] for i in range(len(made))]

    def traced(self, made: Sequence[str], called: Sequence[int]) -> list[str]:
        """As `interleaved`, but what the pullbacks would compute, as text: nothing is compiled,
        which takes nearly all of the time."""
        jax.clear_caches()
        found: dict[int, str] = {}

        def outer(operands, cotangent):
            pullbacks = []
            for name in made:
                chosen = {n: operands[n] for n in PATTERNS[name]}
                pullbacks.append(jax.vjp(lambda xs: self.image(**xs), chosen)[1])
            for i in called:
                text = str(jax.make_jaxpr(pullbacks[i])(cotangent).jaxpr)
                found[i] = re.sub(r" at 0x[0-9a-f]+", "", text)
            return ()

        jax.make_jaxpr(outer)({n: self.operand(n) for n in OPERANDS}, self.cotangent)
        return [found[i] for i in range(len(made))]

    def traced_alone(self) -> dict[str, str]:
        """What each pattern's pullback would compute as the first of a process."""
        return {name: self.traced([name], [0])[0] for name in NAMES}


_OWNERS = {
    "mesh": ("values", "points"),
    "camera": ("eye",),
    "transfer": ("colors", "extinctions", "positions"),
}


def pairs() -> Iterator[tuple[str, str]]:
    """All ordered pairs of patterns, a pattern with itself included."""
    return itertools.product(NAMES, NAMES)


def wrong(made: Sequence[str], found: Sequence[T], alone: dict[str, T]) -> list[str]:
    """The patterns whose gradients differ from what they are alone, in the order of `made`."""
    return [f"{i}: {n}" for i, (n, x) in enumerate(zip(made, found, strict=True)) if x != alone[n]]


def sequences(count: int, seed: int = 0) -> Iterator[tuple[tuple[str, ...], tuple[int, ...]]]:
    """Random sequences of six patterns, and random orders in which their pullbacks are called."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        made = tuple(NAMES[i] for i in rng.integers(len(NAMES), size=6))
        yield made, tuple(int(i) for i in rng.permutation(6))
