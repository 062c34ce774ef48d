"""Compositors: how the pieces along a ray become one pixel.

A compositor is a frozen dataclass, whose numbers are leaves (`base.AbstractCompositor`). Its state
is a pytree of arrays over rays (R,) that `add` updates front to back, or back to front if it is
`backwards`; `finish` makes premultiplied linear RGBA (4, R) of it. `done` says which rays need
nothing of what follows: they stop at the end of their segment. `merge` joins what was cut. For the
replaying adjoint, `pull_back` gives the cotangents of one piece from the state before and after it
and the final state, so that nothing along the ray is stored.

- `Over`: emission and absorption.
- `MaximumIntensity`: the colour of the largest scalar. `XRay`: integrals along rays.

To add one: a file here, one line in the tests' registry.
"""

from jaxvr.composite.base import AbstractCompositor, AbstractSum, Piece, Scale
from jaxvr.composite.maximum_intensity import MaximumIntensity
from jaxvr.composite.over import Over
from jaxvr.composite.xray import XRay

__all__ = [
    "AbstractCompositor",
    "AbstractSum",
    "MaximumIntensity",
    "Over",
    "Piece",
    "Scale",
    "XRay",
]
