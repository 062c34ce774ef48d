"""Hours of the state machine: does what was called before change what is computed?

    python -m experiments.state_machine --minutes 60 --seed 1
    python -m experiments.state_machine --orders 200        # gradients in random orders instead

Rounds of random steps over the public verbs, with other shapes, dtypes, engines and threads than
the tests', each result compared with that of a process without a history (`tests/machine.py`). A
fault is printed as hypothesis's program of steps; then it goes on with the next seed. With
`--orders`, programs of six pullbacks, on both engines and in both precisions, are compared to the
bit of what is computed, or with `--run` of what comes out (`tests/orders.py`).
"""

from __future__ import annotations

import argparse
import sys
import time
import traceback
import warnings
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import hypothesis
import jax
from hypothesis.stateful import run_state_machine_as_test

import jaxvr
from tests import machine, orders


def explore(
    minutes: float, seed: int, steps: int = 10, small: bool = False
) -> tuple[dict[str, int], list[str]]:
    """Runs rounds of three examples of at most `steps` steps, over the recipes of the tests if
    `small`. Returns how many steps of each kind, and the faults."""
    worker, count, faults = machine.Worker(), {}, []
    end = time.monotonic() + 60 * minutes
    settings = hypothesis.settings(
        max_examples=3,  # the first that hypothesis makes is the simplest there is
        stateful_step_count=steps,
        deadline=None,
        database=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=[*hypothesis.HealthCheck],  # pyright: ignore[reportArgumentType]
        print_blob=True,
    )
    try:
        while time.monotonic() < end:
            one = hypothesis.seed(seed)(machine.make_machine(worker, small, count))
            try:
                run_state_machine_as_test(one, settings=settings)
            except Exception:
                faults.append(f"seed {seed}:\n{traceback.format_exc(limit=-4)}")
                print(faults[-1], flush=True)
            print(f"seed {seed}: {sum(count.values())} steps, {len(faults)} faults", flush=True)
            seed += 1
    finally:
        worker.close()
    return count, faults


def all_orders(sequences: int, run: bool, engines: list[bool | None], dtypes: list[str]) -> int:
    """All ordered pairs, then random sequences of six. Returns how many gradients were wrong."""
    bad = 0
    for native in engines:
        for dtype in dtypes:
            scene = orders.Scene(dtype, native)
            how: Any = scene.run if run else scene.trace
            alone = orders.alone(how)
            programs = [*orders.pairs(), *orders.sequences(sequences)]
            for number, program in enumerate(programs):
                wrong = orders.wrong(program, how(program), alone)
                bad += len(wrong)
                if wrong:
                    print(f"{program}: {wrong}", flush=True)
                if number % 20 == 0 or number == len(programs) - 1:
                    name = "JAX's loops" if native is False else "compiled loops"
                    print(
                        f"{name}, {dtype}: {number + 1} of {len(programs)}, {bad} wrong", flush=True
                    )
    return bad


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=10, help="at most, in each example")
    parser.add_argument("--small", action="store_true", help="the tests' recipes only")
    parser.add_argument("--orders", type=int, metavar="N", help="sequences of six, after all pairs")
    parser.add_argument("--run", action="store_true", help="compile and compare the numbers")
    parser.add_argument("--engine", choices=["compiled", "jax"], action="append")
    parser.add_argument("--dtype", choices=["float32", "float64"], action="append")
    options = parser.parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    warnings.simplefilter("ignore", jaxvr.ViewWarning)
    if options.orders is not None:
        engines = [False if e == "jax" else None for e in options.engine or ["compiled", "jax"]]
        dtypes = options.dtype or ["float32", "float64"]
        sys.exit(bool(all_orders(options.orders, options.run, engines, dtypes)))
    count, faults = explore(options.minutes, options.seed, options.steps, options.small)
    print(f"{sum(count.values())} steps: {dict(sorted(count.items()))}")
    print(f"{len(faults)} faults")
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()
