"""Scalar functions that the rest relies on to the last bit or to rounding.

- `moments`: the integrals of one slab, as sums of positive terms, with derivatives of all orders.
- `exact`: error-free sums and products, and predicates whose sign is always right.
- `compensated`: sums that carry their own rounding error.

Everything here is elementwise over arrays of one float dtype, works under jit, vmap, jvp and vjp,
and knows nothing of meshes or images. A new function states its domain, its error bound in both
precisions, and the derivative that it takes at kinks.
"""
