"""Whatever was called before: a state machine over the public verbs.

A `Recipe` says what to compute from nothing but itself. The machine computes recipes in one process
with a history: other recipes, pullbacks alive at once and called in any order, `jit`, `vmap`,
threads, cleared caches, switched engines, errors in between. A `Worker`, a process that clears all
caches before each recipe and is started anew now and then, says what each gives without a history,
once for each recipe. Both must agree to rounding (compiled loops and JAX's own differ by that).

`python -m tests.machine` is the worker: recipes come as lines of JSON, results go as lines of
base64 of `.npz`.
"""

from __future__ import annotations

import base64
import io
import json
import os
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any, NamedTuple

import hypothesis.strategies as st
import jax
import numpy as np
from hypothesis.stateful import Bundle, RuleBasedStateMachine, precondition, rule

import jaxvr

ROOT = Path(__file__).resolve().parents[1]
OPERANDS = ("colors", "extinctions", "positions", "values", "points", "eye", "background")
TOLERANCE = {"float32": 2e-4, "float64": 1e-9}
RECIPES_OF_A_WORKER = 40


class Recipe(NamedTuple):
    """What to compute.

    verb: a key of `VERBS`. mesh: blocks along x. location: of its values. size: pixels along an
    edge. dtype. variant: which numbers (not shapes) to put in. tracer, native: the engine.
    extras: a background and early termination. operands: those of a gradient.
    """

    verb: str = "render"
    mesh: int = 1
    location: str = "point"
    size: int = 4
    dtype: str = "float64"
    variant: int = 0
    points: int = 3
    tracer: str = "RayCast"
    native: bool | None = None
    extras: bool = False
    operands: tuple[str, ...] = ()


class Scene:
    """The operands of a recipe, and the picture as a function of some of them."""

    def __init__(self, recipe: Recipe):
        self.recipe = recipe
        rng = np.random.default_rng([recipe.variant, recipe.mesh, recipe.points])
        dtype = recipe.dtype
        mesh = jaxvr.datasets.box((recipe.mesh, 1, 1), dtype=dtype)
        shape = {"point": (mesh.n_points,), "cell": (mesh.n_tets,), "corner": (mesh.n_tets, 4)}
        values = rng.uniform(0, 1, shape[recipe.location]).astype(dtype)
        self.mesh = mesh.replace(values=values, location=recipe.location)
        at = np.sort(rng.uniform(0.05, 0.95, recipe.points))
        colors = rng.uniform(0.1, 1, (recipe.points, 3))
        extinctions = rng.uniform(0.3, 3, recipe.points)
        self.transfer = jaxvr.TransferFunction(at, colors, extinctions, dtype=dtype)
        self.camera = jaxvr.Camera.orbit(
            mesh, azimuth=31 + 20 * recipe.variant, elevation=17, width=recipe.size,
            height=recipe.size, dtype=dtype,
        )  # fmt: skip
        self.background = rng.uniform(0, 1, 3).astype(dtype)
        self.cotangent = rng.uniform(0.5, 1.5, (recipe.size, recipe.size, 4)).astype(dtype)
        engines = {None: None, True: jaxvr.engine.C(), False: jaxvr.engine.XLA()}
        self.how: dict[str, Any] = {"engine": engines[recipe.native]}
        if recipe.tracer == "KBuffer":
            self.how["tracer"] = jaxvr.KBuffer(k=12)
        if recipe.extras:
            self.how["compositor"] = jaxvr.Over(termination=0.9)

    def operand(self, name: str) -> Any:
        if name in ("values", "points"):
            return getattr(self.mesh, name)
        if name in ("eye", "background"):
            return self.camera.eye if name == "eye" else self.background
        return getattr(self.transfer, name)

    def image(self, given: dict[str, Any] | None = None) -> Any:
        given = dict(given or {})
        mesh = {k: given[k] for k in ("values", "points") if k in given}
        eye = {k: given[k] for k in ("eye",) if k in given}
        other = {k: given[k] for k in ("colors", "extinctions", "positions") if k in given}
        background = given.get("background", self.background if self.recipe.extras else None)
        return jaxvr.render(
            self.mesh.replace(**mesh), self.camera.replace(**eye), self.transfer.replace(**other),
            background=background, **self.how,
        )  # fmt: skip

    def pullback(self) -> Any:
        """A function without arguments that gives the gradients of a recipe."""
        chosen = {k: self.operand(k) for k in self.recipe.operands}
        _, pull = jax.vjp(self.image, chosen)
        return lambda: [pull(self.cotangent)[0][k] for k in self.recipe.operands]

    def segments(self) -> Any:
        tracer = self.how.get("tracer")
        engine = self.how["engine"] if tracer is None else None
        return jaxvr.trace(self.mesh, self.camera, tracer=tracer, engine=engine)

    def shaded(self, segments: Any) -> Any:
        how = {k: v for k, v in self.how.items() if k != "tracer"}
        background = self.background if self.recipe.extras else None
        return jaxvr.shade(segments, self.transfer, background=background, **how)

    def fitted(self) -> list[Any]:
        target = self.image()
        start = self.transfer.replace(colors=np.full_like(self.transfer.colors, 0.5))
        result = jaxvr.fit(
            start, self.mesh, self.camera, target, iterations=2, progress=False,
            background=self.background if self.recipe.extras else None, **self.how,
        )  # fmt: skip
        return [result.transfer.colors, result.loss_history]


def _probed(scene: Scene) -> list[Any]:
    found = jaxvr.probe(scene.mesh, scene.camera, scene.transfer)
    return [found.start, found.distances, found.scalars, found.contributions]


def _rays(scene: Scene) -> list[Any]:
    origins, directions = scene.camera.rays()
    return [jaxvr.render_rays(scene.mesh, origins, directions, scene.transfer, **scene.how)]


VERBS: dict[str, Any] = {
    "render": lambda s: [s.image()],
    "render_rays": _rays,
    "shade": lambda s: [s.shaded(s.segments())],
    "probe": _probed,
    "measure_k": lambda s: [np.asarray(jaxvr.measure_k(s.mesh, s.camera).k)],
    "gradient": lambda s: s.pullback()(),
    "fit": lambda s: s.fitted(),
}


def compute(recipe: Recipe) -> list[np.ndarray]:
    return [np.asarray(x) for x in VERBS[recipe.verb](Scene(recipe))]


def difference(recipe: Recipe, found: list[np.ndarray], want: list[np.ndarray]) -> str | None:
    """What differs between two results by more than rounding, or None."""
    if [x.shape for x in found] != [x.shape for x in want]:
        return f"shapes {[x.shape for x in found]}, alone {[x.shape for x in want]}"
    for i, (a, b) in enumerate(zip(found, want, strict=True)):
        if a.dtype != b.dtype:
            return f"dtype {a.dtype}, alone {b.dtype}"
        a, b = a.astype(float), b.astype(float)
        bound = TOLERANCE[recipe.dtype] * max(float(np.abs(b).max(initial=0)), 1e-3)
        if not np.all(np.abs(a - b) <= bound):
            name = recipe.operands[i] if recipe.operands else f"result {i}"
            return (
                f"{name} is off by {np.abs(a - b).max():.3g}: at most {np.abs(a).max():.3g}, alone "
                f"{np.abs(b).max():.3g}"
            )
    return None


class Worker:
    """Computes recipes in a process without a history; keeps what it has computed."""

    def __init__(self) -> None:
        self.known: dict[Recipe, list[np.ndarray]] = {}
        self.process: subprocess.Popen[str] | None = None
        self.asked = 0

    def alone(self, recipe: Recipe) -> list[np.ndarray]:
        if recipe not in self.known:
            if self.process is not None and self.asked % RECIPES_OF_A_WORKER == 0:
                self.close()
            if self.process is None:
                self.process = subprocess.Popen(
                    [sys.executable, "-m", "tests.machine"], cwd=ROOT, text=True,
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                    env={**os.environ, "JAXVR_NATIVE": "1", "PYTHONPATH": str(ROOT)},
                )  # fmt: skip
            assert self.process.stdin and self.process.stdout
            self.asked += 1
            print(json.dumps(recipe), file=self.process.stdin, flush=True)
            line = self.process.stdout.readline()
            if not line:
                raise RuntimeError(f"The worker died over {recipe}.")
            with np.load(io.BytesIO(base64.b64decode(line))) as file:
                self.known[recipe] = [file[f"arr_{i}"] for i in range(len(file.files))]
        return self.known[recipe]

    def close(self) -> None:
        if self.process is not None:
            assert self.process.stdin and self.process.stdout
            self.process.stdin.close()
            self.process.wait(60)
            self.process.stdout.close()
            self.process = None


def serve() -> None:
    jax.config.update("jax_enable_x64", True)
    for line in sys.stdin:
        *rest, operands = json.loads(line)
        jax.clear_caches()
        file = io.BytesIO()
        np.savez(file, *compute(Recipe(*rest, operands=tuple(operands))))
        print(base64.b64encode(file.getvalue()).decode(), flush=True)


# --- the machine --------------------------------------------------------------------------------

SUBSETS = st.one_of(
    st.sampled_from(OPERANDS).map(lambda k: (k,)),
    st.just(OPERANDS),
    st.sets(st.sampled_from(OPERANDS), min_size=2, max_size=3).map(lambda s: tuple(sorted(s))),
)


def recipes_of(**choices: list[Any]) -> Any:
    """Recipes with these numbers, and defaults for the rest."""
    drawn = {name: st.sampled_from(values) for name, values in choices.items()}
    return st.fixed_dictionaries(drawn).map(lambda given: Recipe(**given))


# Few shapes, so that most recipes are compiled already.
SMALL = recipes_of(dtype=["float64", "float64", "float32"], variant=[0, 1])
LARGE = recipes_of(
    mesh=[1, 2],
    location=["point", "point", "cell", "corner"],
    size=[4, 6],
    dtype=["float64", "float32"],
    variant=[0, 1, 2],
    points=[3, 4],
    tracer=["RayCast", "RayCast", "RayCast", "KBuffer"],
    native=[None, None, None, False],
    extras=[False, True],
)


def bad_calls(scene: Scene) -> list[Any]:
    """Calls that raise, some before and some after something has been traced."""
    mesh, camera, transfer = scene.mesh, scene.camera, scene.transfer
    nan = np.full(mesh.values.shape, np.nan)

    def fails_while_traced(e):
        jaxvr.render(mesh, camera, transfer.replace(extinctions=e))
        raise ValueError("in the middle of a trace")

    return [
        lambda: mesh.replace(values=nan),
        lambda: jaxvr.render(mesh, camera, None),  # pyright: ignore
        lambda: jaxvr.render(mesh, camera, transfer, budget=0),
        lambda: transfer.replace(positions=np.asarray(transfer.positions)[::-1]),
        lambda: jaxvr.render(mesh, camera, transfer, background=(1, 2)),
        lambda: jax.grad(fails_while_traced)(transfer.extinctions),
        lambda: jax.jit(lambda m: jaxvr.trace(m, camera))(mesh),
    ]


def make_machine(worker: Worker, small: bool = True, count: dict[str, int] | None = None) -> Any:
    """A `RuleBasedStateMachine` that asks this worker. count: where steps are counted, by rule."""
    recipes = SMALL if small else LARGE
    steps = {} if count is None else count

    class Verbs(RuleBasedStateMachine):
        pullbacks = Bundle("pullbacks")
        traces = Bundle("traces")

        def hold(self, step: str, recipe: Recipe, found: list[Any]) -> None:
            steps[step] = steps.get(step, 0) + 1
            wrong = difference(recipe, [np.asarray(x) for x in found], worker.alone(recipe))
            assert wrong is None, f"{step} of {recipe}: {wrong}"

        @rule(recipe=recipes, verb=st.sampled_from(["render", "render", "render_rays"]))
        def render(self, recipe, verb):
            recipe = recipe._replace(verb=verb)
            self.hold(verb, recipe, compute(recipe))

        @rule(recipe=recipes, verb=st.sampled_from(["probe", "measure_k"]))
        def look(self, recipe, verb):
            recipe = recipe._replace(verb=verb)
            self.hold(verb, recipe, compute(recipe))

        @rule(target=traces, recipe=recipes)
        def trace(self, recipe):
            recipe = recipe._replace(verb="shade")
            return recipe, Scene(recipe).segments()

        @rule(traced=traces)
        def shade(self, traced):
            recipe, segments = traced
            self.hold("shade", recipe, [Scene(recipe).shaded(segments)])

        @rule(target=pullbacks, recipe=recipes, operands=SUBSETS)
        def make(self, recipe, operands):
            steps["vjp"] = steps.get("vjp", 0) + 1
            recipe = recipe._replace(verb="gradient", operands=operands)
            return recipe, Scene(recipe).pullback()

        @rule(target=pullbacks, recipe=recipes, a=SUBSETS, b=SUBSETS)
        def make_two(self, recipe, a, b):
            """The second's trace must leave nothing to the first."""
            first = recipe._replace(verb="gradient", operands=a)
            pull = Scene(first).pullback()
            Scene(recipe._replace(verb="gradient", operands=b)).pullback()
            steps["vjp"] = steps.get("vjp", 0) + 2
            return first, pull

        @rule(made=pullbacks)
        def call(self, made):
            recipe, pull = made
            self.hold("pullback", recipe, pull())

        @rule(recipe=recipes, operands=SUBSETS)
        def gradient_in_jit(self, recipe, operands):
            recipe = recipe._replace(verb="gradient", operands=operands)
            self.hold("jit(vjp)", recipe, jax.jit(lambda: Scene(recipe).pullback()())())

        @rule(recipe=recipes)
        def vmap(self, recipe):
            """Against a plain loop over what each gives alone."""
            scenes = [Scene(recipe._replace(variant=v)) for v in (0, 1)]
            values = np.stack([s.mesh.values for s in scenes])
            colors = np.stack([s.transfer.colors for s in scenes])
            both = jax.vmap(lambda v, c: scenes[0].image({"values": v, "colors": c}))(
                values, colors
            )
            steps["vmap"] = steps.get("vmap", 0) + 1
            for i, (v, c) in enumerate(zip(values, colors, strict=True)):
                one = scenes[0].image({"values": v, "colors": c})
                wrong = difference(recipe, [np.asarray(both[i])], [np.asarray(one)])
                assert wrong is None, f"vmap of {recipe}, row {i}: {wrong}"
            self.hold("render", recipe._replace(variant=0), [both[0]])

        @rule(recipe=recipes)
        def fit(self, recipe):
            recipe = recipe._replace(verb="fit")
            self.hold("fit", recipe, compute(recipe))

        @rule(recipe=recipes, a=SUBSETS, b=SUBSETS)
        def threads(self, recipe, a, b):
            both = [recipe._replace(verb="gradient", operands=x) for x in (a, b)]
            found: dict[int, Any] = {}

            def work(i: int) -> None:
                try:
                    found[i] = compute(both[i])
                except Exception as error:  # shown by the assertion below
                    found[i] = error

            running = [threading.Thread(target=work, args=(i,)) for i in range(2)]
            for x in running:
                x.start()
            for x in running:
                x.join()
            for i, one in enumerate(both):
                assert isinstance(found[i], list), f"in a thread, {one}: {found[i]!r}"
                self.hold("thread", one, found[i])

        @rule(recipe=recipes, number=st.integers(0, 6))
        def err(self, recipe, number):
            steps["error"] = steps.get("error", 0) + 1
            try:
                bad_calls(Scene(recipe))[number]()
            except ValueError:
                return
            raise AssertionError(f"Bad call {number} of {recipe} raised nothing.")

        @rule()
        def forget(self):
            steps["clear_caches"] = steps.get("clear_caches", 0) + 1
            jax.clear_caches()

        @precondition(lambda self: not small)
        @rule(to=st.sampled_from(["0", "1"]))
        def switch(self, to):
            """Compiled loops off and on: numbers are the same."""
            steps["JAXVR_NATIVE"] = steps.get("JAXVR_NATIVE", 0) + 1
            os.environ["JAXVR_NATIVE"] = to

        def teardown(self):
            os.environ.pop("JAXVR_NATIVE", None)

    return Verbs


if __name__ == "__main__":
    serve()
