"""Visibility orders: in which sequence faces are sent to be rasterised.

An order gives every face a number, its key, for one bundle of rays; faces go by ascending key. None
of the keys that are quick to compute is a visibility order: fragments come out nearly sorted, and
the k-buffer puts right what is left (Callahan et al. 2005). How far from sorted a sequence is, and
what a buffer needs, is defined in `sequence`. `exact_order` makes a visibility order, for one mesh
and one camera, on the host: to compare the others with.

To add one, derive from `AbstractOrder`: a frozen dataclass, since it is static in a tracer.
"""

from jaxvr.order.exact import ExactOrder, exact_order
from jaxvr.order.keys import AbstractOrder, Centroid, Faces, FirstVertex
from jaxvr.order.sequence import (
    displacement,
    entries_needed,
    exactly_sorted,
    is_k_nearly_sorted,
    kbuffer_sort,
    moved,
)

__all__ = [
    "AbstractOrder",
    "Centroid",
    "ExactOrder",
    "Faces",
    "FirstVertex",
    "displacement",
    "entries_needed",
    "exact_order",
    "exactly_sorted",
    "is_k_nearly_sorted",
    "kbuffer_sort",
    "moved",
]
