"""Compositors: how the colours and depths along a ray become one pixel.

A compositor is a frozen dataclass without arrays. Its state is a pytree of arrays over rays (R,)
that `add` updates front to back, or back to front if it is `backwards`; `finish` makes
premultiplied linear RGBA (4, R) of it. `ended` says which rays need nothing of what follows: they
stop at the end of their segment. For the replaying adjoint, `pull_back` gives the cotangents of one
piece from the state before and after it and the final state, so that nothing along the ray is
stored.
"""

from jaxvr.composite.over import Over

__all__ = ["Over"]
