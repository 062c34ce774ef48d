"""Partial pre-integration (Moreland and Angel 2004; Espinha and Celes 2005).

doi:10.1109/SVVG.2004.2, doi:10.1109/SIBGRAPI.2005.29

A slab's integral needs one function of two numbers, psi(a, b), which does not depend on the
transfer function and so is tabulated once for all. What tables there are, and how exact: see
`jaxvr.numerics.tables`.

Espinha and Celes find the control points that a segment crosses with a texture of them, looked up
at every step (their Figures 5 and 6): `crossings="texture"`, see `jaxvr.optics.partition.look_up`.
The other way is to remember which slab a ray is in: what comes next is then a neighbour of it, and
a ray that goes on into the next cell has nothing to look up. Both give the same pieces.
"""

from __future__ import annotations

from jaxvr._core.pytree import noun, static
from jaxvr.numerics.tables import gamma_weights, smooth_weights
from jaxvr.optics.integrator import AbstractSlabIntegrator
from jaxvr.optics.partition import with_texture

LOOKUPS = {
    "bicubic": smooth_weights,
    "bilinear": lambda a, b, size: gamma_weights(a, b, size, nearest=False),
    "nearest": lambda a, b, size: gamma_weights(a, b, size, nearest=True),
}


@noun
class PartialPreIntegration(AbstractSlabIntegrator):
    """Slab integrals from a table of psi, cut at control points like those of `Analytic`.

    table_size: nodes along each axis of the table. lookup: "bicubic" in smooth coordinates, with
    derivatives in closed form; "bilinear" or "nearest" in the papers' gamma coordinates, whose
    colours are off by up to 1e-2 for thick slabs and have few digits for thin ones, and whose
    derivatives are those of the interpolant (for "nearest", without psi's part). Those two are
    here to compare with the literature.
    crossings: "slab" remembers the slab that a ray is in; "texture" looks it up at each step in one
    of `texture_size` texels, as Espinha and Celes do. The result is the same.

    Raises:
      ValueError: for another lookup or way to find crossings, fewer than four nodes, or no texels.
    """

    table_size: int = static(default=128)
    lookup: str = static(default="bicubic")
    crossings: str = static(default="slab")
    texture_size: int = static(default=512)

    def __post_init__(self):
        if self.lookup not in LOOKUPS:
            raise ValueError(f"lookup must be one of {list(LOOKUPS)}, but is {self.lookup!r}.")
        if not isinstance(self.table_size, int) or self.table_size < 4:
            raise ValueError(f"table_size must be an integer >= 4, but is {self.table_size!r}.")
        if self.crossings not in ("slab", "texture"):
            raise ValueError(f"crossings must be 'slab' or 'texture', but is {self.crossings!r}.")
        if not isinstance(self.texture_size, int) or self.texture_size < 1:
            raise ValueError(f"texture_size must be an integer >= 1, not {self.texture_size!r}.")

    def prepare(self, transfer, dtype, longest):
        nodes = super().prepare(transfer, dtype, longest)
        return with_texture(nodes, self.texture_size) if self.crossings == "texture" else nodes

    def weights(self, a, b):
        return LOOKUPS[self.lookup](a, b, self.table_size)
