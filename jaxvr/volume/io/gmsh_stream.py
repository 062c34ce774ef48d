"""Numbers in a section of a gmsh file, and the types of its elements: see `gmsh`."""

from __future__ import annotations

import numpy as np

from .content import Trouble

# number: (name, nodes). Corners come first.
TYPES = {
    1: ("line", 2), 2: ("triangle", 3), 3: ("quad", 4), 4: ("tetra", 4), 5: ("hexahedron", 8),
    6: ("wedge", 6), 7: ("pyramid", 5), 8: ("line3", 3), 9: ("triangle6", 6), 10: ("quad9", 9),
    11: ("tetra10", 10), 12: ("hexahedron27", 27), 13: ("wedge18", 18), 14: ("pyramid14", 14),
    15: ("vertex", 1), 16: ("quad8", 8), 17: ("hexahedron20", 20), 18: ("wedge15", 15),
    19: ("pyramid13", 13), 20: ("triangle9", 9), 21: ("triangle10", 10), 22: ("triangle12", 12),
    23: ("triangle15", 15), 24: ("triangle15", 15), 25: ("triangle21", 21), 26: ("line4", 4),
    27: ("line5", 5), 28: ("line6", 6), 29: ("tetra20", 20), 30: ("tetra35", 35),
    31: ("tetra56", 56), 36: ("quad16", 16), 37: ("quad25", 25), 38: ("quad36", 36),
    90: ("wedge40", 40), 91: ("wedge75", 75), 92: ("hexahedron64", 64), 93: ("hexahedron125", 125),
    118: ("pyramid30", 30), 119: ("pyramid55", 55),
}  # fmt: skip


class Stream:
    """Numbers of one section, text or binary. Raises Trouble behind its end."""

    def __init__(self, raw: bytes, name: str, binary: bool, order: str, size: int):
        self.name, self.binary, self.order, self.size = name, binary, order, size
        self.raw, self.at = raw, 0
        self.words: list[bytes] | None = None if binary else raw.split()
        self.left = len(raw) if binary else len(self.words or ())

    def take(self, n: int, dtype: str, width: int) -> np.ndarray:
        cost = n * width if self.binary else n
        if n < 0 or cost > self.left:
            left = self.left // width if self.binary else self.left
            raise Trouble(
                "damaged",
                f"${self.name} asks for {n} numbers where {left} are left: it is cut short, or its "
                "counts are wrong",
            )
        self.left -= cost
        try:
            if self.binary:
                out = np.frombuffer(self.raw, self.order + dtype, n, self.at)
                self.at += cost
                return out
            assert self.words is not None
            words = self.words[self.at : self.at + n]
            self.at += n
            if dtype == "f8":
                return np.array([float(w) for w in words])
            return np.array([int(w) for w in words], np.int64)
        except (ValueError, OverflowError) as e:
            raise Trouble("damaged", f"${self.name}: {e}") from None

    def ints(self, n: int) -> np.ndarray:
        return self.take(n, "i4", 4).astype(np.int64)

    def sizes(self, n: int) -> np.ndarray:
        """Numbers of size_t (version 4.1) or unsigned long (4.0)."""
        got = self.take(n, "u8" if self.size == 8 else "u4", self.size)
        return got.astype(np.int64)

    def floats(self, n: int) -> np.ndarray:
        return self.take(n, "f8", 8)

    def table(self, rows: int, columns: int) -> np.ndarray:
        return self.ints(rows * columns).reshape(rows, columns)
