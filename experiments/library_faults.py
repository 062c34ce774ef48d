"""States of the compiled library's cache and of its environment, and what becomes of each.

    python -m experiments.library_faults [--json FILE] [--tiny]

The file is cut, changed, replaced, given away; the folder, the variables, the compiler and the
disk are as they should not be; builds are killed at each of their steps, and several run at once.
In each state a new process loads the library, twice, and one in 25 renders with it. It may find the
sound one (`kept`), make it anew (`rebuilt`), or go without, with one warning (`JAX's loops`). It
must not crash, hang, raise, warn twice, or map a file with another content. The compiler is a
script that copies a sound library, so that a state takes a fraction of a second.

Processes are forks of one that has imported JAX and computed nothing, so the states are tried in a
process of its own. As root, states of permissions are tried as another user.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.common import table
from experiments.library_place import GOOD, NOBODY, Place, Process, State, Untried
from experiments.library_states import states
from jaxvr.native import build

EVERY = 25  # one of so many states renders


def compiler_that_copies(base: Path, sound: Path) -> None:
    shutil.copyfile(sound, base / "sound.so")
    script = base / "cc"
    script.write_text(
        '#!/bin/sh\nfor x in "$@"; do [ "$last" = -o ] && out="$x"; last="$x"; done\n'
        f'exec cp {base}/sound.so "$out"\n'
    )
    script.chmod(0o755)
    (base / "sound.so").chmod(0o755)


def attempt(place: Place, state: State, render: bool) -> dict[str, Any]:
    """The outcome of a state: the worst of its processes."""
    try:
        state.prepare(place)
        if state.other_user and os.getuid() == 0:
            for path in (place.root, place.folder, *place.folder.glob("*"), *place.root.glob("c*")):
                if path.lstat().st_uid == 0 and state.kind != "owner":
                    os.chown(path, NOBODY, -1, follow_symlinks=False)
        running = [Process(place, state, render) for _ in range(state.processes)]
        found = [p.wait() for p in running]
        return max(found, key=lambda x: (x["outcome"] not in GOOD, x["outcome"]))
    except Untried as error:
        return {"outcome": "not tried", "words": str(error)}
    finally:
        subprocess.run(["umount", str(place.folder)], capture_output=True)


def try_all(many: int, every: int, only: str | None = None) -> dict[str, Any]:
    """In a process that has computed nothing. every: one of so many states is tried. only:
    those of a kind."""
    warnings.simplefilter("ignore")
    jax.config.update("jax_platforms", "cpu")
    start, rows, want = time.monotonic(), [], None
    with tempfile.TemporaryDirectory(prefix="faults-", ignore_cleanup_errors=True) as folder:
        base = Path(folder)
        base.chmod(0o755)
        jax.config.update("jax_compilation_cache_dir", str(base / "xla"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
        compiler_that_copies(base, build.build("float32"))
        os.environ |= {"JAXVR_CC": str(base / "cc"), "JAXVR_CACHE": str(base / "first")}
        name = build.build("float32").name
        chosen = states((base / "sound.so").read_bytes(), many)
        for number, state in enumerate(chosen[::every]):
            if only not in (None, state.kind):
                continue
            root = base / f"{number}"
            place = Place(base, root, name)
            plain = not state.other_user and state.kind not in ("disk", "umask", "at once")
            render = number % EVERY == 0 and plain
            found = attempt(place, state, render)
            if render and found["outcome"] in GOOD:
                picture = np.array(found["picture"])
                want = picture if want is None else want
                if not np.allclose(picture, want, atol=1e-6, rtol=0):
                    found["outcome"] = "another picture"
            bad = found["outcome"] not in (*GOOD, "not tried")
            words = found.get("words", "").replace(str(base), "...")[-300:]
            rows.append(
                {"kind": state.kind, "state": state.name, "rendered": render}
                | {"outcome": found["outcome"], "words": words if bad else ""}
            )
            if bad:
                print(rows[-1], file=sys.stderr, flush=True)
            # Not by shutil: folders may be nested deeper than Python's stack.
            subprocess.run(["rm", "-rf", str(root)], capture_output=True)
    return {"states": rows, "seconds": round(time.monotonic() - start)}


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """States of each kind by outcome."""
    kinds = list(dict.fromkeys(r["kind"] for r in rows))
    others = sorted({r["outcome"] for r in rows} - set(GOOD))
    out = []
    for kind in (*kinds, "all"):
        count = Counter(r["outcome"] for r in rows if kind in (r["kind"], "all"))
        out.append(
            {"kind": kind, "states": count.total()} | {k: count[k] for k in (*GOOD, *others)}
        )
    return out


def main(arguments: list[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--tiny", action="store_true")
    parser.add_argument("--only", help="states of a kind")
    parser.add_argument("--here", action="store_true", help="not in a process of its own")
    args = parser.parse_args(arguments)
    if args.here:
        many, every = (4, 24) if args.tiny else (20, 1)
        print(json.dumps(try_all(many, every, args.only)))
        return {}
    run = [sys.executable, "-m", "experiments.library_faults", "--here"]
    root = Path(__file__).resolve().parents[1]
    quiet = os.environ | {"TF_CPP_MIN_LOG_LEVEL": "3"}  # of XLA's own cache
    done = subprocess.run(
        run + ["--tiny"] * args.tiny + (["--only", args.only] if args.only else []),
        cwd=root,
        env=quiet,
        stdout=subprocess.PIPE,
        check=True,
    )
    report = json.loads(done.stdout.splitlines()[-1])
    report["table"] = summary(report["states"])
    print(table(report["table"]), flush=True)
    if args.json:
        odd = [r for r in report["states"] if r["outcome"] not in GOOD]
        kept = {"seconds": report["seconds"], "table": report["table"], "others": odd}
        args.json.write_text(json.dumps(kept, indent=1) + "\n")
    return report


if __name__ == "__main__":
    main()
