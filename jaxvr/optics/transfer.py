"""`TransferFunction`: colour and extinction as piecewise linear functions of the scalar.

Between its control points a transfer function is linear, outside them constant. Two control points
at one position are a jump: below it the first counts, at it and above it the second. Emission
follows the density emitter of Williams and Max ("A volume density optical model", 1992): along a
ray dI = extinction(s) * color(s) * exp(-optical depth) dl, with extinction per unit of length.
"""

from __future__ import annotations

import dataclasses
import functools
import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxvr._core.brief import dtype_of, is_known, length_of, spanned
from jaxvr._core.checks import (
    as_floats,
    common_float,
    is_concrete,
    require_finite,
    require_shape,
)
from jaxvr._core.offsets import (
    absolute,
    added,
    coarse,
    coarse_step,
    digits_of,
    is_single,
    moved,
    offset_between,
    offset_of,
    relative,
    require_said,
)
from jaxvr._core.warn import warn
from jaxvr.optics import colormaps

Array = jax.Array


@jax.tree_util.register_pytree_with_keys_class
@dataclasses.dataclass(frozen=True, eq=False, init=False)
class TransferFunction:
    """A piecewise linear map from scalars to colours and extinctions, with K control points.

    positions (K,):   scalar values, never decreasing; two equal ones are a jump, three an error.
        However near two others are, they are none. Relative to `offset`. Where digits were lost
        before they came, as in JAX's float32 far from 0, a warning says how many are left; inside
        `jit` nobody knows.
    colors (K, 3):    linear RGB; any finite number (above 1 for lights brighter than white).
        Integers above 1 are an error, since they are taken for 8-bit colours.
    extinctions (K,): per unit of length, >= 0, any size.

    offset:           what the positions are relative to; no leaf, but part of the tree's structure.
        0 but for scalars far from 0 and close together, of which float32 would keep too few digits
        (101325 to 101325.01): passed as plain numbers or in float64, they have one taken off.
        `absolute_positions` puts it back. Passing `offset` says that positions are relative to it.
        Positions of JAX's float32, and traced ones, are held as they are.

    The three share one dtype: that of the arrays passed, JAX's default float for plain numbers, or
    `dtype`. Calling the class checks everything; under `jit` and `grad`, where values are not
    known, it checks the shapes. Rebuilding from leaves (`jax.tree`) checks nothing, so gradients
    and other trees of the same structure are TransferFunctions too. Warns where float32 makes two
    positions one, or changes the distance between them by more than a sixteenth.
    """

    positions: Array
    colors: Array
    extinctions: Array
    offset: float

    def __init__(
        self,
        positions: Any,
        colors: Any,
        extinctions: Any,
        *,
        offset: float | None = None,
        dtype: Any = None,
    ):
        dtype = common_float(dtype, positions, colors, extinctions)
        given, told = positions, offset
        positions, offset = _less_offset(positions, offset, dtype)
        _require_unit_colors("colors", colors)
        colors = as_floats("colors", colors, ndim=2, dtype=dtype)
        extinctions = as_floats("extinctions", extinctions, ndim=1, dtype=dtype)
        k = positions.shape[0]
        if k == 0:
            raise ValueError("A transfer function needs at least one control point, but has none.")
        require_shape("colors", colors, (k, 3))
        require_shape("extinctions", extinctions, (k,))
        require_finite("positions", positions)
        require_finite("colors", colors)
        require_finite("extinctions", extinctions)
        _require_sorted(positions)
        _require_nonnegative(extinctions)
        if told is None:  # else they are relative to it, or meant to be as they are
            tell_coarse(given)
        _set(self, jnp.asarray(positions), jnp.asarray(colors), jnp.asarray(extinctions), offset)

    # JAX's register_dataclass would run `__init__`, and its checks, at every unflatten.
    def tree_flatten_with_keys(self) -> tuple[tuple[tuple[Any, Any], ...], float]:
        names = ("positions", "colors", "extinctions")
        keyed = tuple((jax.tree_util.GetAttrKey(n), getattr(self, n)) for n in names)
        return keyed, self.offset

    def tree_flatten(self) -> tuple[tuple[Any, ...], float]:
        return (self.positions, self.colors, self.extinctions), self.offset

    @classmethod
    def tree_unflatten(cls, aux: float, leaves: Any) -> TransferFunction:
        self = object.__new__(cls)
        positions, colors, extinctions = leaves
        _set(self, positions, colors, extinctions, aux)
        return self

    @staticmethod
    def from_colormap(
        colormap: Any,
        positions: Any,
        extinctions: Any,
        srgb: bool = False,
        *,
        points: int | None = None,
        offset: float | None = None,
        dtype: Any = None,
    ) -> TransferFunction:
        """Control points at `positions` (K,) with colours from a colour map.

        colormap: the name of a matplotlib colour map, a function from numbers in [0, 1] (n,) to
            colours (n, 3) or (n, 4), or a table (n, 3) or (n, 4) that is interpolated linearly. It
            spans positions[0] to positions[-1] linearly; alpha is ignored.
        srgb: colour maps are made for display, and their numbers are taken as linear RGB as they
            stand, so that a picture saved as it is shows them unchanged. With True they are decoded
            from sRGB first (then save pictures with `srgb=True`).
        points: add control points, so that the map is followed at this many evenly spaced positions
            beside the given ones (between control points colours are interpolated linearly).
        offset: what positions are relative to; None for scalars as they are.

        Raises ValueError for an unknown name, a malformed table, or positions that are traced.
        """
        if not is_concrete(positions):
            raise ValueError("from_colormap needs known positions; call it outside jit and grad.")
        dtype, given = common_float(dtype, positions, extinctions), positions
        positions = np.asarray(as_floats("positions", positions, ndim=1, dtype=np.float64))
        require_finite("positions", positions)
        _require_sorted(positions)
        if not isinstance(colormap, str) and not callable(colormap):
            _require_unit_colors("The colour table", colormap)
        colors = colormaps.sample(colormap, _span(positions), srgb=srgb)
        tf = TransferFunction(given, colors.astype(dtype), extinctions, offset=offset, dtype=dtype)
        if points is None:
            return tf
        if points < 1:
            raise ValueError(f"points must be at least 1, but is {points}.")
        own = np.asarray(tf.positions)
        away = tf.offset - (offset or 0.0)
        extra = (np.linspace(positions[0], positions[-1], points) - away).astype(dtype)
        extra = extra[~np.isin(extra, own)]
        merged = np.sort(np.concatenate([own, extra]))
        fine = colormaps.sample(colormap, _span(merged.astype(np.float64)), srgb=srgb)
        return tf._resampled(jnp.asarray(merged)).replace(colors=fine.astype(dtype))

    @staticmethod
    def from_opacity(
        positions: Any,
        colors: Any,
        opacities: Any,
        unit_distance: Any = 1.0,
        convention: str = "unstructured",
        *,
        max_opacity: float | None = None,
        dtype: Any = None,
    ) -> TransferFunction:
        """From opacities (K,) in [0, 1] that hold for a length of `unit_distance`, as VTK has them.

        VTK (and ParaView) means two things by one opacity o:

            "unstructured": extinction = o / unit_distance           (unstructured grids)
            "grid":         alpha = 1 - (1 - o)^(length / unit_distance), so that
                            extinction = -log(1 - o) / unit_distance  (regular grids)

        `colors` (K, 3), or a colour map as in `from_colormap`. In the grid convention an opacity of
        1 is an infinite extinction and so a ValueError, unless `max_opacity` < 1 is given, to which
        larger opacities are then lowered.
        """
        _require_convention(convention)
        dtype = common_float(dtype, positions, colors, opacities)
        opacities = as_floats("opacities", opacities, ndim=1, dtype=dtype)
        unit = as_floats("unit_distance", unit_distance, ndim=0, dtype=dtype)
        require_finite("opacities", opacities)
        _require_unit(unit)
        if is_concrete(opacities):
            o = np.asarray(opacities)
            if ((o < 0) | (o > 1)).any():
                k = int(np.argmax((o < 0) | (o > 1)))
                raise ValueError(f"Opacities lie between 0 and 1, but opacities[{k}] is {o[k]:g}.")
        if max_opacity is not None:
            if not 0 <= max_opacity <= 1:
                raise ValueError(f"max_opacity must lie in [0, 1], but is {max_opacity:g}.")
            opacities = jnp.minimum(opacities, jnp.asarray(max_opacity, dtype))
        if convention == "grid":
            if is_concrete(opacities) and (np.asarray(opacities) == 1).any():
                k = int(np.argmax(np.asarray(opacities) == 1))
                raise ValueError(
                    f"opacities[{k}] is 1, which on a regular grid means an infinite extinction. "
                    "Lower it, or pass max_opacity (0.999, say) to do so for all."
                )
            extinctions = -jnp.log1p(-jnp.asarray(opacities)) / unit
        else:
            extinctions = jnp.asarray(opacities) / unit
        if isinstance(colors, str) or callable(colors):
            return TransferFunction.from_colormap(colors, positions, extinctions, dtype=dtype)
        return TransferFunction(positions, colors, extinctions, dtype=dtype)

    def to_opacity(self, unit_distance: Any = 1.0, convention: str = "unstructured") -> Array:
        """Opacities (K,) for a length of `unit_distance`, the inverse of `from_opacity`.

        In the "unstructured" convention they may exceed 1; choose a smaller unit then.
        """
        _require_convention(convention)
        unit = as_floats("unit_distance", unit_distance, ndim=0, dtype=self.dtype)
        _require_unit(unit)
        if convention == "grid":
            return -jnp.expm1(-self.extinctions * unit)
        return self.extinctions * unit

    def __call__(self, scalars: Any) -> tuple[Array, Array]:
        """Colours (..., 3) and extinctions (...) at `scalars` (...), as they are: with an `offset`
        plain numbers and NumPy's float64 keep all digits.

        At a jump it is the upper side's value. Differentiable in the scalars and in every field:
        at a control point the derivative is that of the interval above it, outside the control
        points that in the scalar is zero, and a jump's height has no part in it. NaN gives NaN.
        """
        return self._evaluate(scalars, "right")

    def _evaluate(self, scalars: Any, side: str) -> tuple[Array, Array]:
        if self.offset:
            self._tell_coarse(scalars)
            scalars = relative(scalars, self.offset, self.dtype)
        s = jnp.asarray(scalars)
        return _evaluate(self, s.astype(jnp.promote_types(s.dtype, self.dtype)), side)

    def _tell_coarse(self, scalars: Any) -> None:
        """Warns of scalars in float32 beside positions that are held relative to an offset."""
        if not is_concrete(self.positions) or not is_single(scalars) or self.positions.ndim != 1:
            return
        width = float(self.positions[-1]) - float(self.positions[0])
        if step := coarse_step(scalars, width):
            warn(
                f"scalars come in float32, which has steps of {step:.2g} there, for positions over "
                f"{width:.3g}. What was lost is not to be had back: pass NumPy's float64.",
                UserWarning,
            )

    def resample(self, positions: Any) -> TransferFunction:
        """This function at other control points (M,); the same function if they include all of K.

        Where `positions` names a position twice, the two get the values on either side of it, so
        jumps survive when they are named; else a jump becomes a ramp between its new neighbours.
        """
        given = positions
        if self.offset:
            positions = relative(_wide("positions", positions), self.offset, self.dtype)
        positions = as_floats("positions", positions, ndim=1, dtype=self.dtype)
        require_finite("positions", positions)
        _require_sorted(positions)
        tell_coarse(given)
        if positions.shape[0] == 0:
            raise ValueError("resample needs at least one position, but got none.")
        return self._resampled(jnp.asarray(positions))

    def _resampled(self, positions: Array) -> TransferFunction:
        """`resample` at positions (M,) that are relative to the offset."""
        upper_c, upper_e = _evaluate(self, positions, "right")
        lower_c, lower_e = _evaluate(self, positions, "left")
        first = jnp.concatenate([positions[:-1] == positions[1:], jnp.zeros(1, bool)])
        colors, extinctions = (
            jnp.where(first[:, None], lower_c, upper_c),
            jnp.where(first, lower_e, upper_e),
        )
        return TransferFunction(positions, colors, extinctions, offset=self.offset)

    def with_points(self, n: int) -> TransferFunction:
        """Resampled at `n` evenly spaced control points from the first position to the last."""
        if n < 2 or self.positions.shape[0] < 2:
            raise ValueError(
                f"with_points needs n >= 2 and a function with at least two control points, "
                f"but n is {n} and there are {self.positions.shape[0]}."
            )
        return self._resampled(jnp.linspace(self.positions[0], self.positions[-1], n))

    def scaled(self, extinction_factor: Any) -> TransferFunction:
        """With all extinctions multiplied by extinction_factor (), a number >= 0."""
        factor = as_floats("extinction_factor", extinction_factor, ndim=0, dtype=self.dtype)
        return self.replace(extinctions=self.extinctions * factor)

    def replace(self, **changes: Any) -> TransferFunction:
        """With some fields changed, checked like a new one; the dtype stays.

        positions: relative to `offset`; where this function has one, say `offset=` with them.
        """
        fields = {"positions", "colors", "extinctions", "offset"}
        if unknown := set(changes) - fields:
            raise ValueError(
                f"A transfer function has no {sorted(unknown)}, only {sorted(fields)}."
            )
        if "offset" in changes and "positions" not in changes:
            raise ValueError("offset says what positions are relative to: pass positions too.")
        if "positions" in changes and changes.get("offset") is None:
            require_said("positions", "offset", self.offset)
            changes["offset"] = None
        return TransferFunction(
            changes.get("positions", self.positions),
            changes.get("colors", self.colors),
            changes.get("extinctions", self.extinctions),
            offset=changes.get("offset", self.offset),
            dtype=self.dtype,
        )

    def astype(self, dtype: Any) -> TransferFunction:
        """In float32 or float64."""
        return TransferFunction(
            self.positions, self.colors, self.extinctions, offset=self.offset, dtype=dtype
        )

    def absolute_positions(self) -> np.ndarray:
        """The positions (K,) as scalars are, float64: with the offset. Not inside `jit`."""
        return absolute(self.positions, self.offset)

    def relative_to(self, offset: float, dtype: Any = None) -> TransferFunction:
        """The same function with its positions relative to another offset. Differentiable.

        dtype: as for `Camera.relative_to`. Warns where float32 makes two positions one there, or
        changes the distance between them by more than a sixteenth.
        """
        offset, dtype = offset_of(offset), self.dtype if dtype is None else np.dtype(dtype)
        positions = moved(self.positions, self.offset, offset, dtype)
        changed = offset != self.offset or dtype.itemsize < self.dtype.itemsize
        if changed and positions.ndim == 1 and is_concrete(positions):
            before, after = self.absolute_positions(), absolute(positions, offset)
            _tell_moved(before, after, dtype)
        others = (jnp.asarray(x).astype(dtype) for x in (self.colors, self.extinctions))
        return TransferFunction.tree_unflatten(offset, (positions, *others))

    @property
    def dtype(self) -> np.dtype:
        """The dtype of the three fields."""
        return np.dtype(self.positions.dtype)

    def __repr__(self) -> str:
        # leaves may be tracers or placeholders
        x, e = self.positions, self.extinctions
        known = ""
        if is_known(x, e) and x.ndim == 1 and x.size and e.size:
            x, e = self.absolute_positions(), np.asarray(e)
            known = f"{spanned(x[0], x[-1])}, extinction up to {e.max():.6g}, "
        return f"TransferFunction({length_of(x)} control points, {known}{dtype_of(self.positions)})"

    def _repr_html_(self) -> str | None:
        from jaxvr.optics.html import transfer_html

        return transfer_html(self)  # None: notebooks show the repr

    def to_json(self, path: str | os.PathLike[str] | None = None) -> str:
        """JSON text that gives the same numbers back; also written to `path` if there is one."""
        from jaxvr.optics import transfer_json

        return transfer_json.write(self, path)

    @staticmethod
    def from_json(
        source: Any,
        *,
        unit_distance: float = 1.0,
        convention: str = "unstructured",
        points: int = 256,
        name: str | None = None,
        srgb: bool = False,
        dtype: Any = None,
    ) -> TransferFunction:
        """From what `to_json` wrote, or from a colour map exported by ParaView as JSON.

        source: a path, JSON text, or what `json.load` returned. dtype: defaults to that of the file
        (float64 only where JAX allows it), for ParaView's files to JAX's default float. The rest is
        for ParaView's files: unit_distance and convention as in `from_opacity`; points: about how
        many control points to add where a curve is not linear; name: which colour map, if there are
        several; srgb: decode colours from sRGB. A colour for NaN ("NanColor") is left out without a
        warning, since no field has NaN: a mesh refuses it. Raises ValueError for neither format.
        """
        from jaxvr.optics import transfer_json

        return transfer_json.read(
            source,
            unit_distance=unit_distance,
            convention=convention,
            points=points,
            name=name,
            srgb=srgb,
            dtype=dtype,
        )

    @staticmethod
    def from_vtk(
        color: Any,
        opacity: Any = None,
        unit_distance: float | None = None,
        *,
        convention: str = "unstructured",
        points: int = 256,
        dtype: Any = None,
    ) -> TransferFunction:
        """From VTK's functions or PyVista's, with every node of both as a control point.

        color, opacity: a vtkColorTransferFunction and a vtkPiecewiseFunction, with midpoints,
            sharpness and colour spaces; or one vtkVolumeProperty or volume that has both (what
            PyVista's `add_volume` returns); or a vtkLookupTable, pyvista.LookupTable for one or
            for both.
        unit_distance, convention: what an opacity means, as in `from_opacity`; `None` takes the
            property's scalar opacity unit distance, or 1. In the "unstructured" convention
            opacities may exceed 1, as in VTK.
        points: about how many control points to add where a curve is not linear.
        dtype: defaults to JAX's default float.

        With clamping off there is a jump to 0 at either end. Raises ValueError for other objects,
        functions without nodes, and opacities that `from_opacity` does not take.
        """
        from jaxvr.optics import transfer_vtk

        return transfer_vtk.read(
            color, opacity, unit_distance, convention=convention, points=points, dtype=dtype
        )

    def to_vtk(self, unit_distance: float = 1.0) -> tuple[Any, Any]:
        """A vtkColorTransferFunction and a vtkPiecewiseFunction for unstructured grids.

        The opacities are extinction * unit_distance; give the same number to the property, with
        `SetScalarOpacityUnitDistance`. Jumps are two nodes at one place. `from_vtk` gives the same
        numbers back, to rounding where `unit_distance` is no power of two. Raises ValueError where
        an opacity would exceed 1, with a unit distance that is small enough. Needs VTK:
        `pip install vtk`.
        """
        from jaxvr.optics import transfer_vtk

        return transfer_vtk.write(self, unit_distance)


@functools.partial(jax.jit, static_argnames="side")
def _evaluate(tf: TransferFunction, s: Array, side: str) -> tuple[Array, Array]:
    k = tf.positions.shape[0]
    above = jnp.searchsorted(tf.positions, s, side=side)
    lo, hi = jnp.clip(above - 1, 0, k - 1), jnp.clip(above, 0, k - 1)
    start, width = tf.positions[lo], tf.positions[hi] - tf.positions[lo]
    # Outside the control points lo == hi; both operands of the division are guarded, so that
    # neither an infinite scalar nor the zero width gives a NaN in the unused branch.
    inside = width > 0
    step = jnp.where(inside, s, start) - start
    t = jnp.where(inside, step / jnp.where(inside, width, 1), jnp.where(jnp.isnan(s), s, 0))
    below_c, below_e = tf.colors[lo], tf.extinctions[lo]
    colors = below_c + t[..., None] * (tf.colors[hi] - below_c)
    return colors, below_e + t * (tf.extinctions[hi] - below_e)


# What rounding may change of the distance of two positions, as a part of it.
_MOVED = 1 / 16


def _less_offset(positions: Any, offset: Any, dtype: Any) -> tuple[Any, float]:
    """Positions (K,) in `dtype` and what they are relative to. See `TransferFunction`."""
    said = 0.0 if offset is None else offset_of(offset)
    given = _wide("positions", positions)
    as_it_is = is_single(positions) and offset is not None
    if isinstance(given, jax.Array) or as_it_is or given.ndim != 1 or len(given) == 0:
        return as_floats("positions", given, ndim=1, dtype=dtype), said
    ends = float(given[0]), float(given[-1])
    away = offset_between(*ends, dtype) if np.isfinite(ends).all() else 0.0
    total, away = added(said, away)
    with np.errstate(over="ignore"):  # infinite, and found by whoever checks
        held = (given - away).astype(dtype)
    _tell_moved(given, held.astype(np.float64) + away, dtype)
    return held, total


def tell_coarse(positions: Any) -> None:
    """Warns of digits that sorted positions, as they came, had lost before."""
    if said := coarse(positions):
        warn(f"positions {said}", UserWarning)


def _wide(name: str, x: Any) -> Any:
    """Floats as they come: NumPy's float64 but for JAX's float32 and what is traced."""
    x = digits_of(x)
    return x if isinstance(x, jax.Array) else as_floats(name, x, dtype=np.float64)


def _tell_moved(given: np.ndarray, held: np.ndarray, dtype: Any) -> None:
    """Warns of positions (K,), float64, that are others as they are held, beside how far they are
    from each other."""
    with np.errstate(invalid="ignore"):  # what overflows is found by whoever checks
        apart, error = np.diff(given), np.abs(np.diff(held - given))
    merged = np.flatnonzero((held[1:] == held[:-1]) & (apart > 0))
    shifted = np.flatnonzero((error > apart * _MOVED) & (apart > 0))
    for found, what in (
        (merged, f"are one in {np.dtype(dtype)}, and make a jump"),
        (shifted, f"are no longer as far from each other in {np.dtype(dtype)}"),
    ):
        if len(found):
            k = int(found[0])
            warn(
                f"{len(found)} pairs of positions {what}: the first are positions[{k}] = "
                f"{given[k]:.17g} and [{k + 1}] = {given[k + 1]:.17g}. Numbers far from each other "
                "need float64.",
                UserWarning,
            )
            return


def _set(tf: TransferFunction, positions: Any, colors: Any, extinctions: Any, offset: Any) -> None:
    object.__setattr__(tf, "offset", offset)
    object.__setattr__(tf, "positions", positions)
    object.__setattr__(tf, "colors", colors)
    object.__setattr__(tf, "extinctions", extinctions)


def _span(positions: np.ndarray) -> np.ndarray:
    """Where each position lies between the first (0) and the last (1)."""
    if len(positions) == 0:
        return positions
    width = positions[-1] - positions[0]
    return (positions - positions[0]) / width if width > 0 else np.linspace(0, 1, len(positions))


def _require_sorted(positions: Any) -> None:
    if not is_concrete(positions):
        return
    p = np.asarray(positions)
    down = np.flatnonzero(p[1:] < p[:-1])
    if len(down):
        k = int(down[0])
        raise ValueError(
            f"positions must not decrease, but positions[{k + 1}] = {p[k + 1]:g} comes after "
            f"positions[{k}] = {p[k]:g}. Sort the control points."
        )
    triple = np.flatnonzero(p[2:] == p[:-2])
    if len(triple):
        k = int(triple[0])
        raise ValueError(
            f"Two equal positions make a jump, but positions[{k}], [{k + 1}] and [{k + 2}] are all "
            f"{p[k]:g}. Keep the first and the last of them."
        )


def _require_nonnegative(extinctions: Any) -> None:
    if not is_concrete(extinctions):
        return
    e = np.asarray(extinctions)
    if (e < 0).any():
        k = int(np.argmax(e < 0))
        raise ValueError(
            f"Extinctions must not be negative, but {int((e < 0).sum())} of {len(e)} are, the "
            f"first extinctions[{k}] = {e[k]:g}."
        )


def _require_unit_colors(name: str, colors: Any) -> None:
    """ValueError for whole numbers that can only be 0 to 255: a light of 255 times white."""
    if not is_concrete(colors) or np.dtype(getattr(colors, "dtype", int)).kind not in "iu":
        return
    try:
        c = np.asarray(colors)
    except (TypeError, ValueError):
        return  # said by whoever reads them
    if c.dtype.kind in "iu" and c.size and c.max() > 1:
        raise ValueError(
            f"{name} holds integers up to {c.max()}, but 1 is full intensity. Divide 8-bit colours "
            "by 255; for lights brighter than white pass floats."
        )


def _require_convention(convention: str) -> None:
    if convention not in ("unstructured", "grid"):
        raise ValueError(f"convention must be 'unstructured' or 'grid', but is {convention!r}.")


def _require_unit(unit: Any) -> None:
    if is_concrete(unit) and not 0 < float(unit) < np.inf:
        raise ValueError(f"unit_distance must be a length above 0, but is {float(unit):g}.")
