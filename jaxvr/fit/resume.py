"""Where a fit keeps its state on the way, so that it can go on later as if it had never stopped.

The place is tried before the first step. From then on nothing that goes wrong with it ends the fit:
its result is worth more than its checkpoint, and a warning says what could not be written.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from jaxvr._core.warn import warn
from jaxvr._core.writing import place_of, require_place, shown
from jaxvr.fit import checkpoint as files
from jaxvr.fit.differences import CheckpointWarning

WHAT = "The checkpoint"


def prepare(path: Any, resume: bool) -> int:
    """Looks at the place before anything is computed.

    Gives the iterations that a fit from the start would replace. Raises OSError if nothing can be
    written there, ValueError if a file is there that is no checkpoint.
    """
    if path is None:
        return 0
    try:
        place = place_of(path)
        place.parent.mkdir(parents=True, exist_ok=True)
    except FileExistsError as e:
        reason = f"{shown(place.parent)} is no folder"
        raise NotADirectoryError(f"{WHAT} cannot be written to {shown(path)}: {reason}.") from e
    except (OSError, ValueError, TypeError) as e:
        reason = getattr(e, "strerror", None) or str(e)
        kind = OSError if isinstance(e, OSError) else ValueError
        raise kind(f"{WHAT} cannot be written to {shown(path)}: {reason}.") from e
    require_place(path, WHAT)
    return 0 if resume else files.require_replaceable(path)


class Keeper:
    """Reads and writes the checkpoint of one fit; without a path it does nothing.

    about: from a number of iterations to what the state after them belongs to, for `files.load`.
    """

    def __init__(self, path: Any, every: int, about: Callable[[int], dict[str, Any]]):
        # Where it was when the fit began, wherever the process goes meanwhile.
        self._path = None if path is None else os.path.abspath(os.path.expanduser(path))
        self._every, self._about = every, about
        self._failed, self._saved = False, 0

    def restored(self, state: Any, iterations: int) -> tuple[Any, list[float]]:
        """State and losses of the file, or the state as it is if there is none."""
        if not place_of(self._path).exists():
            return state, []
        state, losses = files.load(self._path, state, self._about)
        self._saved = len(losses)
        if len(losses) > iterations:
            message = (
                f"{WHAT} {shown(self._path)} holds {len(losses)} iterations, more than the "
                f"{iterations} asked for: the result is that after {len(losses)}."
            )
            warn(message, CheckpointWarning)
        return state, losses

    def step(self, state: Any, losses: list[float]) -> None:
        """After each step: writes now and then."""
        if self._path is not None and len(losses) % self._every == 0:
            self._save(state, losses)

    def end(self, state: Any, losses: list[float]) -> None:
        """After the last step: writes what is not written yet."""
        if self._path is not None and self._saved != len(losses):
            self._failed = False
            self._save(state, losses)

    def _save(self, state: Any, losses: list[float]) -> None:
        try:
            files.save(self._path, state, losses, self._about(len(losses)))
            self._saved = len(losses)
        except Exception as e:
            if not self._failed:
                reason = getattr(e, "strerror", None) or str(e) or type(e).__name__
                kept = f"after {self._saved} iterations" if self._saved else "not there"
                message = (
                    f"{WHAT} could not be written to {shown(self._path)} after {len(losses)} "
                    f"iterations: {reason}. The fit goes on; the last state kept is {kept}."
                )
                warn(message, CheckpointWarning)
            self._failed = True
