"""`Camera`: a pinhole or an orthographic view, and the ray through each pixel's centre.

With `forward = normalize(target - eye)`, `right = normalize(forward x up)` and
`true_up = right x forward`, pixel (i, j) (row 0 on top) lies at

    x = ((2j + 1)/width - 1) * h * width/height,    y = (1 - (2i + 1)/height) * h,

where `h` is tan(fov/2) for a pinhole and extent/2 for an orthographic camera. A pinhole's rays
start at the eye along normalize(forward + x*right + y*true_up); orthographic rays start at
eye + x*right + y*true_up along `forward`. What lies behind the start of a ray is not seen.
"""

from __future__ import annotations

import dataclasses
import math
import operator
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxvr._core.brief import brief, dtype_of
from jaxvr._core.checks import (
    as_floats,
    common_float,
    float_dtype,
    is_concrete,
    require_finite,
    require_shape,
)
from jaxvr._core.offsets import (
    NOWHERE,
    Origin,
    absolute,
    added,
    coarse_step,
    digits_of,
    is_single,
    offset_between,
    origin_of,
    require_said,
    said,
)
from jaxvr._core.offsets import moved as moved_to
from jaxvr._core.pytree import pytree, static
from jaxvr._core.stage import stage
from jaxvr._core.units import near_one
from jaxvr._core.warn import warn

Array = jax.Array


class HasBounds(Protocol):
    """Anything that a camera can orbit."""

    def bounds(self) -> tuple[Any, Any]:
        """The lower and the upper corner (3,), (3,) of the axis-aligned bounding box; relative to
        `origin`, where there is such an attribute."""
        ...


class HasRays(Protocol):
    """A camera: what gives a ray for each pixel. `Camera` is one; one of another maker may be any
    object, and a pytree if it is to be differentiated."""

    @property
    def width(self) -> int: ...

    @property
    def height(self) -> int: ...

    def rays(self) -> tuple[Any, Any]:
        """Origins and directions (height, width, 3) in the world, row 0 on top; directions of any
        length but 0. For volumes far from 0 in float32 give NumPy's float64."""
        ...


@pytree
class RayImage:
    """Rays (height, width, 3) of an image: origins relative to a volume's, and directions."""

    origins: Array
    directions: Array

    @property
    def height(self) -> int:
        return self.origins.shape[0]

    @property
    def width(self) -> int:
        return self.origins.shape[1]

    def local_rays(self) -> tuple[Array, Array]:
        return self.origins, self.directions


@pytree
class Camera:
    """A view of the world. Make one with `look_at`, `orthographic`, `orbit` or `sphere`.

    eye (3,):     where the camera stands, in world units, relative to `origin`.
    target (3,):  a point in the middle of the picture, relative to `origin`.
    up (3,):      the direction that points up in the picture; need not be perpendicular or unit.
    fov ():       full vertical angle in degrees of a pinhole camera, else None.
    extent ():    full vertical height in world units of an orthographic camera, else None.
    width, height: pixels; part of the tree's structure.
    origin (3,):  plain numbers, part of the structure. 0 but in float32 for a target that lies far
        from 0 beside the eye's distance: given as plain numbers or in float64 the two have it
        taken off before they are rounded. `orbit` takes that of the volume. JAX's float32, and what
        is traced, is held as it is.

    The arrays share one dtype, which is that of the rays. The rays are differentiable in eye,
    target, up and fov or extent. The factories and `replace` check their arguments (values only
    when they are concrete); calling the class itself checks nothing.
    """

    eye: Array
    target: Array
    up: Array
    fov: Array | None
    extent: Array | None
    width: int = static(default=512)
    height: int = static(default=512)
    origin: Origin = static(default=NOWHERE)

    @staticmethod
    def look_at(
        eye: Any,
        target: Any,
        up: Any = (0.0, 1.0, 0.0),
        fov: Any = 30.0,
        width: int = 512,
        height: int = 512,
        *,
        dtype: Any = None,
    ) -> Camera:
        """A pinhole camera at `eye` (3,) that looks at `target` (3,).

        `dtype` defaults to that of the arrays among eye, target and up, and to JAX's default float
        when these are plain numbers. Raises ValueError for numbers that are not finite, eye equal
        to target, up along the view, fov outside (0, 180), a picture without pixels.
        """
        return _make(eye, target, up, fov, None, width, height, dtype)

    @staticmethod
    def orthographic(
        eye: Any,
        target: Any,
        up: Any = (0.0, 1.0, 0.0),
        extent: Any = 1.0,
        width: int = 512,
        height: int = 512,
        *,
        dtype: Any = None,
    ) -> Camera:
        """A camera with parallel rays that start in the plane through `eye`.

        `extent` is the full height of the picture in world units. Otherwise as `look_at`.
        """
        return _make(eye, target, up, None, extent, width, height, dtype)

    @staticmethod
    def orbit(
        volume: HasBounds,
        azimuth: Any = 30.0,
        elevation: Any = 20.0,
        fov: Any = 30.0,
        zoom: Any = 1.0,
        width: int = 512,
        height: int = 512,
        *,
        up: Any = (0.0, 1.0, 0.0),
        dtype: Any = None,
    ) -> Camera:
        """A pinhole camera on a sphere round the volume; at zoom 1 its bounding ball fits the fov.

        target = centre of the bounding box, R = half its diagonal, eye = target
        + R/sin(fov/2)/zoom * (cos(el) sin(az), sin(el), cos(el) cos(az)). Azimuth az, elevation el
        and fov are in degrees; from azimuth 0 one looks along -z.

        up (3,): what elevation 90 looks down from, known numbers; those three then are parts of the
        axes that `orbit_axes(up)` gives. With z up, (0, 0, 1), the eye goes along
        (cos(el) cos(az), cos(el) sin(az), sin(el)).

        The dtype defaults to that of `volume.bounds()`. Raises ValueError as `look_at` does, for
        zoom <= 0, and for an elevation of +-90 degrees (up would point along the view: use
        `look_at` with another up).
        """
        lo, hi = _bounds_of(volume)
        given = getattr(lo, "dtype", None)
        dtype = (
            common_float(dtype, lo) if given is None or dtype is not None else float_dtype(given)
        )
        named = {"azimuth": azimuth, "elevation": elevation, "fov": fov, "zoom": zoom}
        az, el, angle, magnification = (_scalar(name, x, dtype) for name, x in named.items())
        _require_between("fov", angle, 0.0, 180.0, "degrees")
        _require_between("zoom", magnification, 0.0, math.inf)
        corners = [jnp.asarray(as_floats("bounds", c, ndim=1, dtype=dtype)) for c in (lo, hi)]
        target = 0.5 * (corners[0] + corners[1])
        diagonal = corners[1] - corners[0]
        unit = near_one(diagonal)
        radius = 0.5 * jnp.linalg.norm(diagonal * unit) / unit
        distance = radius / jnp.sin(jnp.deg2rad(angle) / 2) / magnification
        az, el = jnp.deg2rad(az), jnp.deg2rad(el)
        outward = jnp.stack([jnp.cos(el) * jnp.sin(az), jnp.sin(el), jnp.cos(el) * jnp.cos(az)])
        axes = orbit_axes(up)
        if (axes != np.eye(3)).any():
            x, y, z = (jnp.asarray(axis, dtype) for axis in axes)
            outward = outward[0] * x + outward[1] * y + outward[2] * z
        eye = target + distance * outward
        origin = getattr(volume, "origin", NOWHERE)
        return _make(eye, target, up, angle, None, width, height, dtype, origin)

    @staticmethod
    def sphere(
        volume: HasBounds,
        n: int,
        fov: Any = 30.0,
        zoom: Any = 1.0,
        width: int = 512,
        height: int = 512,
        *,
        dtype: Any = None,
    ) -> list[Camera]:
        """`n` orbiting cameras spread evenly over the sphere, on a Fibonacci lattice; volume, fov,
        zoom, width, height and dtype as for `orbit`.

        View k has sin(elevation) = 1 - (2k + 1)/n and azimuth k times the golden angle
        (González, "Measurement of areas on a sphere using Fibonacci and latitude-longitude
        lattices", 2010, doi:10.1007/s11004-009-9257-x); no view looks along up. DiffDVR (Weiss and
        Westermann, 2021, doi:10.1109/TVCG.2021.3114769) fits to eight such views.
        """
        n = _positive("n", n)
        golden = 180.0 * (3.0 - math.sqrt(5.0))
        return [
            Camera.orbit(
                volume,
                azimuth=math.fmod(k * golden, 360.0),
                elevation=math.degrees(math.asin(1.0 - (2 * k + 1) / n)),
                fov=fov,
                zoom=zoom,
                width=width,
                height=height,
                dtype=dtype,
            )
            for k in range(n)
        ]

    @staticmethod
    def from_vtk(
        source: Any, width: int | None = None, height: int | None = None, dtype: Any = None
    ) -> Camera:
        """The view of a source: a vtkCamera, a pyvista.Camera, a vtkRenderer or a pyvista.Plotter.

        width, height: in pixels; `None` takes those of the plotter's or renderer's window, or 512
            for a camera alone.

        A parallel projection becomes an orthographic camera with extent = 2 * parallel scale. The
        clipping range is ignored. `jaxvr.view.camera_vtk` says how pixels lie in both. Raises
        ValueError for other objects and for skewed projections (a window centre, a view shear).
        """
        from jaxvr.view import camera_vtk

        return camera_vtk.read(source, width, height, dtype)

    def to_vtk(self, into: Any = None) -> Any:
        """This view as a new vtkCamera, or set in the camera, renderer or plotter `into`.

        Returns the vtkCamera. `camera.to_vtk(plotter)` sets a pyvista.Plotter's camera and the size
        of its window. VTK makes view up a unit vector. Needs VTK: `pip install vtk`.
        """
        from jaxvr.view import camera_vtk

        return camera_vtk.write(self, into)

    @property
    def dtype(self) -> np.dtype:
        """The dtype of the rays."""
        return np.dtype(self.eye.dtype)

    def __repr__(self) -> str:
        # leaves may be tracers or placeholders
        kind = "extent" if self.fov is None else "fov"
        parts = ", ".join(f"{n}={brief(getattr(self, n))}" for n in ("eye", "target", "up", kind))
        where = f"relative to {said(self.origin)}, " if any(self.origin) else ""
        size = f"{self.width} x {self.height} pixels"
        return f"Camera({parts}, {where}{size}, {dtype_of(self.eye)})"

    def replace(self, **changes: Any) -> Camera:
        """This camera with some fields changed, checked as the factories do.

        Passing `fov` to an orthographic camera, or `extent` to a pinhole, turns it into the other
        kind. The dtype stays. eye and target are relative to `origin`; where the camera has one,
        say `origin=` with them: 0 for the world, which keeps its digits as in `look_at`.
        """
        names = {f.name for f in dataclasses.fields(self)}
        if unknown := set(changes) - names:
            raise ValueError(f"A camera has no {sorted(unknown)}, only {sorted(names)}.")
        old = {name: getattr(self, name) for name in names}
        if changes.get("fov") is not None:
            old["extent"] = None
        elif changes.get("extent") is not None:
            old["fov"] = None
        moved = [name for name in ("eye", "target") if name in changes]
        if "origin" in changes and not moved:
            raise ValueError("origin says what eye and target are relative to: pass them too.")
        if moved and changes.get("origin") is None:
            require_said(" and ".join(moved), "origin", self.origin)
            changes["origin"] = self.origin
        origin = origin_of(changes.get("origin", self.origin))
        wide = any(not is_single(digits_of(changes[name])) for name in moved)
        for name in ("eye", "target"):
            if name in changes or origin == self.origin and not wide:
                continue
            if wide and is_concrete(old[name]):
                old[name] = absolute(old[name], self.origin) - origin
            else:
                old[name] = moved_to(old[name], self.origin, origin, self.dtype)
        new = old | changes | {"origin": origin}
        return _make(**new, dtype=self.dtype)

    def relative_to(self, origin: Any, dtype: Any = None) -> Camera:
        """The same view with eye and target relative to another origin (3,). Differentiable.

        dtype: what the camera is cast to, its own if None; of it and its own the wider one is
        subtracted in.
        """
        origin, dtype = origin_of(origin), self.dtype if dtype is None else dtype
        eye, target = (moved_to(x, self.origin, origin, dtype) for x in (self.eye, self.target))
        camera = dataclasses.replace(self, eye=eye, target=target, origin=origin)
        return jax.tree.map(lambda x: jnp.asarray(x).astype(dtype), camera)

    def absolute(self) -> tuple[np.ndarray, np.ndarray]:
        """eye and target (3,), (3,) in the world, float64. Not inside `jit`."""
        return absolute(self.eye, self.origin), absolute(self.target, self.origin)

    def basis(self) -> tuple[Array, Array, Array]:
        """The unit vectors right, true_up and forward, (3,) each."""
        # By powers of two near 1, where squares neither under- nor overflow.
        ahead = self.target - self.eye
        forward = _normalize(ahead * near_one(ahead))
        right = _normalize(jnp.cross(forward, self.up * near_one(self.up)))
        return right, jnp.cross(right, forward), forward

    def rays(self) -> tuple[Array, Array]:
        """Origins and unit directions (height, width, 3), (height, width, 3), one ray a pixel.

        The same bits inside of any `jit` and outside: what XLA fuses decides which products and
        sums are rounded once, so rays are made in kernels of their own (see `_core.stage`). Those
        of a camera whose eye is NaN have no direction, and are told as lost.

        In the world: with an `origin` the origins are NumPy's float64, since float32 would not keep
        them. Raises ValueError for such a camera inside `jit`: there render with the camera.
        """
        origins, directions = self.local_rays()
        if not any(self.origin):
            return origins, directions
        if not is_concrete(origins):
            raise ValueError(
                f"The rays of a camera far from 0, relative to {said(self.origin)}, cannot be made "
                "in float32 inside jit. Render with the camera, or turn on x64."
            )
        return absolute(origins, self.origin), directions  # type: ignore[return-value]

    def local_rays(self) -> tuple[Array, Array]:
        """`rays` whose origins are relative to `origin`, in the camera's dtype."""
        return _rays(self)


@jax.jit
def _rays(camera: Camera) -> tuple[Array, Array]:
    return stage(jnp.all(camera.eye == camera.eye), _make_rays, camera)


def _make_rays(camera: Camera) -> tuple[Array, Array]:
    w, h, dtype = camera.width, camera.height, camera.dtype
    if camera.fov is not None:
        half = jnp.tan(jnp.deg2rad(camera.fov) / 2)
    else:
        assert camera.extent is not None
        half = camera.extent / 2
    # The pixel grid is a constant, rounded once from float64.
    x = jnp.asarray(((2 * np.arange(w) + 1) / w - 1) * (w / h), dtype) * half
    y = jnp.asarray(1 - (2 * np.arange(h) + 1) / h, dtype) * half
    right, true_up, forward = (v[None, None, :] for v in camera.basis())
    offset = x[None, :, None] * right + y[:, None, None] * true_up
    if camera.fov is not None:
        directions = _normalize(forward + offset)
        return jnp.broadcast_to(camera.eye, offset.shape), directions
    return camera.eye[None, None, :] + offset, jnp.broadcast_to(forward, offset.shape)


def _normalize(v: Array) -> Array:
    return v / jnp.sqrt(jnp.sum(v * v, axis=-1, keepdims=True))


def orbit_axes(up: Any) -> np.ndarray:
    """A right-handed frame (3, 3) float64: what azimuth 90, elevation 90 and neither look from.

    The second row is `up` (3,), as a unit vector. The third is the axis of the world that is
    farthest from it, among equals z before x before y, made perpendicular to it. So the frame is
    the world's own where y is up. Raises ValueError for what is no direction.
    """
    if not is_concrete(up):
        raise ValueError("up must be known numbers: an orbit's axes are chosen by them.")
    up = np.asarray(_vector("up", up, None), np.float64)
    if not up.any():
        raise ValueError("up is the zero vector; pass a direction such as (0, 1, 0).")
    y = _unit(up)
    world = np.eye(3)[[2, 0, 1]]
    z = world[np.argmin(np.abs(world @ y))]
    z = z - (z @ y) * y
    z /= np.linalg.norm(z)
    return np.stack([np.cross(y, z), y, z])


def _bounds_of(volume: Any) -> tuple[Any, Any]:
    """The box of what has one, or a ValueError that says how to get it."""
    if not callable(getattr(volume, "bounds", None)):
        raise ValueError(
            f"volume must be a jaxvr.TetMesh, but is a {type(volume).__name__}. Read files with "
            "jaxvr.read_mesh, take grids of PyVista with jaxvr.TetMesh.from_pyvista."
        )
    return volume.bounds()


def _make(
    eye: Any,
    target: Any,
    up: Any,
    fov: Any,
    extent: Any,
    width: Any,
    height: Any,
    dtype: Any,
    origin: Origin | None = None,
) -> Camera:
    """origin: what eye and target are relative to; None for the world."""
    dtype = common_float(dtype, eye, target, up)
    eye, target, origin = _less_origin(eye, target, dtype, origin)
    eye, target, up = (_vector(*v, dtype) for v in (("eye", eye), ("target", target), ("up", up)))
    if fov is not None and extent is not None:
        raise ValueError("A camera has a fov (pinhole) or an extent (orthographic), not both.")
    if fov is not None:
        fov = _scalar("fov", fov, dtype)
        _require_between("fov", fov, 0.0, 180.0, "degrees")
    elif extent is not None:
        extent = _scalar("extent", extent, dtype)
        _require_between("extent", extent, 0.0, math.inf, "world units")
    else:
        raise ValueError("A camera needs a fov (pinhole) or an extent (orthographic).")
    _require_view(eye, target, up, dtype)
    width, height = _positive("width", width), _positive("height", height)
    return Camera(
        jnp.asarray(eye), jnp.asarray(target), jnp.asarray(up), fov, extent, width, height, origin
    )


def _less_origin(eye: Any, target: Any, dtype: Any, said: Origin | None) -> tuple[Any, Any, Origin]:
    """Eye and target relative to an origin near the target, where they are far from 0 beside the
    distance from one to the other, and known in more digits than those of JAX's float32."""
    origin = NOWHERE if said is None else said
    wide = digits_of(eye), digits_of(target)
    if any(isinstance(x, jax.Array) for x in wide):
        return eye, target, origin
    wide = [as_floats(n, x, dtype=np.float64) for n, x in zip(("eye", "target"), wide, strict=True)]
    if any(x.shape != (3,) or not np.isfinite(x).all() for x in wide):
        return eye, target, origin  # said by whoever checks
    far = float(np.abs(wide[1] - wide[0]).max())
    away = np.asarray([offset_between(float(t), float(t), np.float32, far) for t in wide[1]])
    single = [x for x in (eye, target) if is_single(x)]
    if said is not None and len(single) == 2:
        return eye, target, origin
    for name, x in (("eye", eye), ("target", target)):
        if away.any() and (step := coarse_step(x, far)):
            warn(
                f"{name} comes in float32, which has steps of {step:.2g} there, {far:.3g} from the "
                "other of eye and target. What was lost is not to be had back: pass float64.",
                UserWarning,
            )
    if np.dtype(dtype) != np.float32:
        return eye, target, origin
    origin, away = added(origin, away)
    return wide[0] - away, wide[1] - away, origin


def _vector(name: str, x: Any, dtype: Any) -> Any:
    x = as_floats(name, x, dtype=dtype)
    require_shape(name, x, (3,))
    require_finite(name, x)
    return x


def _scalar(name: str, x: Any, dtype: Any) -> Array:
    x = as_floats(name, x, dtype=dtype)
    require_shape(name, x, ())
    return jnp.asarray(x)


def _require_between(name: str, x: Any, low: float, high: float, unit: str = "") -> None:
    if is_concrete(x) and not low < float(x) < high:
        unit = f" {unit}" if unit else ""
        raise ValueError(
            f"{name} must lie between {low:g} and {high:g}{unit}, but is {float(x):g}."
        )


def _positive(name: str, n: Any) -> int:
    try:
        if isinstance(n, bool | np.bool_):
            raise TypeError
        n = operator.index(n)
    except TypeError:
        raise ValueError(f"{name} must be a whole number, but is {n!r}.") from None
    if n < 1:
        raise ValueError(f"{name} must be at least 1, but is {n}.")
    return n


def _require_view(eye: Any, target: Any, up: Any, dtype: Any) -> None:
    if not is_concrete(eye, target, up):
        return
    eye, target, up = (np.asarray(v, np.float64) for v in (eye, target, up))
    forward = target - eye
    if not forward.any():
        raise ValueError(f"eye and target are the same point {eye.tolist()}: there is no view.")
    if not up.any():
        raise ValueError("up is the zero vector; pass a direction such as (0, 1, 0).")
    sine = np.linalg.norm(np.cross(_unit(forward), _unit(up)))
    if sine < 16 * np.finfo(dtype).eps:
        raise ValueError(
            f"up {up.tolist()} is parallel to the view direction {_unit(forward).tolist()}; "
            "pass another up."
        )


def _unit(v: np.ndarray) -> np.ndarray:
    v = v / np.abs(v).max()
    return v / np.linalg.norm(v)
