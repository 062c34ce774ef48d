"""`Pace`: how many pixels a picture may have that follows a hand."""

from __future__ import annotations

from collections import deque

# Sides of a coarse picture are those of the exact one divided by one of these.
DIVISORS = (1, 2, 3, 4, 6, 8, 12, 16)
SMALLEST = 8


class Pace:
    """The finest divisor whose pictures take less than `goal` seconds, as far as was measured.

    width, height: pixels of the exact picture. coarse: pixels of the longer side of a coarse one;
    None measures. Time is taken to grow with the pixels, which is all but true. Each size compiles
    once, so it changes only for a reason: where pictures are too slow, or could be much finer.
    """

    def __init__(self, width: int, height: int, coarse: int | None = None, goal: float = 0.06):
        self.width, self.height, self.goal = width, height, goal
        self.fixed = coarse is not None
        self.divisor: float = 4 if coarse is None else max(max(width, height) / coarse, 1)
        self._exact_seconds: deque[float] = deque(maxlen=5)

    def size(self, divisor: float) -> tuple[int, int]:
        """Width and height for a divisor."""
        if divisor == 1:
            return self.width, self.height
        return tuple(min(max(round(n / divisor), SMALLEST), n) for n in (self.width, self.height))  # type: ignore[return-value]

    def observe(self, divisor: float, seconds: float) -> None:
        """A picture at a divisor took so long, compiling apart."""
        self._exact_seconds.append(seconds * divisor**2)

    def expected(self, divisor: float) -> float:
        """Seconds for a picture: the median of the last few. 0 before any."""
        if not self._exact_seconds:
            return 0.0
        return sorted(self._exact_seconds)[len(self._exact_seconds) // 2] / divisor**2

    def wanted(self) -> float:
        """The divisor to go on with."""
        if self.fixed or not self._exact_seconds:
            return self.divisor
        finer = max((d for d in DIVISORS if d < self.divisor), default=None)
        fast = self.expected(self.divisor) <= self.goal
        if fast and (finer is None or self.expected(finer) > 0.7 * self.goal):
            return self.divisor
        return next((d for d in DIVISORS if self.expected(d) <= 0.85 * self.goal), DIVISORS[-1])
