"""What was read, what was made of it and what was repaired: the static part of a `TetMesh`."""

from __future__ import annotations

import dataclasses

# The part of all cells from which on those that float32 distorts are warned of.
COARSE = 0.1

Counts = tuple[tuple[str, int], ...]


@dataclasses.dataclass(frozen=True)
class MeshReport:
    """Counts from `TetMesh.from_cells`; hashable, so it may stand in a pytree's structure.

    input_cells: cells by type as given. reduced: those of them reduced to their corners.
    ignored: points, lines and faces among the cells, left out. degenerate, inverted: tetrahedra
    dropped for having a point twice, and given the wrong way round. flat: those kept that have no
    volume, or none beyond the rounding of their points; crowded: those dropped, since some face
    would have had three cells. collapsed: those without volume, kept or dropped, that have one in
    the float64 that was given, but not in the float32 of the mesh. folded: tetrahedra that lie the
    wrong way round among their neighbours, whichever way they are written; flat ones do not. seams:
    faces whose two cells use different but coincident points. one_sided: components without a
    consistent orientation. components: sets of cells that hang together by faces, 0 if that was not
    counted. coarse: tetrahedra of which float32 moves a corner by more than a thousandth of their
    shortest edge. field: the field's name where it is known.
    """

    input_cells: Counts = ()
    reduced: Counts = ()
    ignored: Counts = ()
    tets: int = 0
    degenerate: int = 0
    crowded: int = 0
    flat: int = 0
    inverted: int = 0
    collapsed: int = 0
    folded: int = 0
    seams: int = 0
    duplicate_points: int = 0
    one_sided: int = 0
    coarse: int = 0
    components: int = 0
    field: str | None = None

    @property
    def n_input(self) -> int:
        return sum(n for _, n in self.input_cells)

    def warning(self) -> str | None:
        """One sentence on what was repaired, or `None`."""
        counts = (
            (self.degenerate, "degenerate tetrahedra (a point twice) dropped"),
            (self.crowded, "flat tetrahedra dropped (three to a face)"),
            (self.flat, "flat tetrahedra (no volume) kept"),
            (self.inverted, "inverted tetrahedra turned round"),
        )
        done = [f"{n} {what}" for n, what in counts if n]
        made = self.tets + self.degenerate + self.crowded
        advice = f" {collapse(self.collapsed)}" if self.collapsed else ""
        return f"{' and '.join(done)}, of {made} in the mesh.{advice}" if done else None

    def lines(self) -> list[tuple[str, str]]:
        """The report for people: labels and what stands behind them."""

        def listed(counts: Counts) -> str:
            return ", ".join(f"{n:,} {name}" for name, n in counts) or "unknown"

        repairs = (
            (self.degenerate, "degenerate dropped"),
            (self.crowded, "flat dropped"),
            (self.flat, "flat kept"),
            (self.inverted, "inverted turned"),
        )
        repaired = ", ".join(f"{n:,} {what}" for n, what in repairs if n) or "nothing"
        out = [("cells given", listed(self.input_cells))]
        if self.reduced:
            out.append(("cut to corners", listed(self.reduced)))
        if self.ignored:
            out.append(("ignored", f"{listed(self.ignored)} (not solid)"))
        out.append(("repaired", repaired))
        if self.duplicate_points:
            closing = (
                f"{self.duplicate_points:,} coincide with others, closing {self.seams:,} faces"
            )
            out.append(("points", closing))
        if self.folded:
            out.append(("folded", f"{self.folded:,} tetrahedra overlap their neighbours"))
        if self.coarse:
            out.append(("coarse", f"{self.coarse:,} tetrahedra are small beside float32's steps"))
        if self.one_sided:
            out.append(("one-sided", f"{self.one_sided:,} components"))
        return out


def collapse(count: int) -> str:
    """Why so many cells lost their volume, and what to do."""
    return (
        f"{count} of them have a volume in float64: points lose digits in float32, beside whose "
        "steps these cells are too small. Turn on x64 "
        '(jax.config.update("jax_enable_x64", True)).'
    )


def coarse_warning(coarse: int, tets: int) -> str | None:
    """One sentence on cells that float32 distorts, or `None` where those are few."""
    if coarse <= COARSE * tets:
        return None
    return (
        f"{coarse} of {tets} tetrahedra are so small beside the steps of float32 "
        "where they lie that rounding moves their corners by more than a thousandth of an "
        "edge. Write points in float64, or relative to a place in their middle; where parts of "
        "a mesh are far from each other, turn on x64 "
        '(jax.config.update("jax_enable_x64", True)).'
    )
