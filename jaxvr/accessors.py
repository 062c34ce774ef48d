"""jaxvr on PyVista's own objects: `grid.jaxvr` and `plotter.jaxvr`.

    image = pyvista.read("file.vtu").jaxvr.render("density")

PyVista 0.48 and newer find this module by the entry points `pyvista.accessors` and
`pyvista.plotter_components` of the installed package, and import it when `.jaxvr` is first asked
for. Older ones have no such door: there `import jaxvr.accessors` opens it.

No type checker knows of attributes that one package gives to the classes of another. So annotate:
`look: jaxvr.accessors.GridAccessor = grid.jaxvr`, and `PlotterComponent` for a plotter.
"""

from __future__ import annotations

import dataclasses
import os
import warnings
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jaxvr._core.offsets import NOWHERE
from jaxvr.defaults import default_transfer
from jaxvr.files import pixels, save_image
from jaxvr.optics import TransferFunction
from jaxvr.probe import Probe, probe
from jaxvr.render import render
from jaxvr.view.camera import Camera
from jaxvr.view.images import composite_over
from jaxvr.volume.mesh import TetMesh

if TYPE_CHECKING:
    from jaxvr.interact.widget import Explorer

# On regular grids VTK's opacity of 1 hides at once, an infinite extinction: it is lowered to this.
OPAQUE = 0.999
UP = (0.0, 0.0, 1.0)  # as PyVista looks at things


class GridAccessor:
    """What jaxvr does with a grid of PyVista: `grid.jaxvr`.

    field, location: as for `TetMesh.from_pyvista`; None takes the grid's active scalars. The mesh
    is made anew by each call, so that what was changed in the grid is seen: keep `mesh()` where
    there are many.
    """

    def __init__(self, dataset: Any):
        self._dataset = dataset

    def mesh(
        self, field: str | None = None, *, location: str | None = None, dtype: Any = None
    ) -> TetMesh:
        """The grid as a `TetMesh`, as `TetMesh.from_pyvista` makes it."""
        return TetMesh.from_pyvista(self._dataset, field, location=location, dtype=dtype)

    def render(
        self,
        field: str | None = None,
        transfer: TransferFunction | str = "viridis",
        camera: Camera | None = None,
        *,
        location: str | None = None,
        **options: Any,
    ) -> jax.Array:
        """A picture (height, width, 4), premultiplied linear RGBA.

        transfer: a transfer function, or the name of a colour map for `default_transfer`.
        camera: None takes `Camera.orbit(mesh, up=(0, 0, 1))`, since z is up in PyVista's views.
        options: of `jaxvr.render`: background, integrator, ...

        Raises and warns as `TetMesh.from_pyvista` and `jaxvr.render` do.
        """
        mesh = self.mesh(field, location=location)
        if not isinstance(transfer, TransferFunction):
            transfer = default_transfer(mesh, transfer)
        camera = Camera.orbit(mesh, up=UP) if camera is None else camera
        return render(mesh, camera, transfer, **_plain(options))

    def probe(
        self,
        camera: Camera | tuple[Any, Any],
        transfer: TransferFunction | str = "viridis",
        pixels: Any = None,
        *,
        field: str | None = None,
        location: str | None = None,
        **options: Any,
    ) -> Probe:
        """What lies under pixels of a camera, or along rays: as `jaxvr.probe`.

        transfer: a transfer function, or the name of a colour map for `default_transfer`.
        """
        mesh = self.mesh(field, location=location)
        if not isinstance(transfer, TransferFunction):
            transfer = default_transfer(mesh, transfer)
        return probe(mesh, camera, transfer, pixels, **options)

    def explore(
        self,
        field: str | None = None,
        transfer: TransferFunction | None = None,
        camera: Camera | None = None,
        *,
        location: str | None = None,
        **options: Any,
    ) -> Explorer:
        """A widget to turn the volume in, for notebooks: as `jaxvr.explore`, with its options."""
        from jaxvr.interact import explore

        return explore(self.mesh(field, location=location), transfer, camera, **options)

    def __repr__(self) -> str:
        return f"jaxvr on a {type(self._dataset).__name__}: mesh, render, probe, explore"


class PlotterComponent:
    """What jaxvr does with the scene of a PyVista plotter: `plotter.jaxvr`.

    The scene is the plotter's camera and window, and the one volume that its active renderer
    shows: the data, colours, opacities, unit distance and matrix of what `add_volume` added.
    Points of image data whose volume property interpolates by the nearest (`add_volume` leaves it
    so) become cells round them; with `volume.prop.interpolation_type = "linear"` values are linear
    between points. Unstructured grids are linear with either, as VTK draws them.
    """

    def __init__(self, plotter: Any):
        self._plotter = plotter

    def scene(self, volume: Any = None) -> tuple[TetMesh, Camera, TransferFunction]:
        """The arguments for `jaxvr.render`.

        volume: which one of those that `add_volume` returned; None takes the only one.

        An opacity of 1 on image data, which hides all behind it at once, counts as 0.999. Raises
        ValueError where there is no volume or more than one, for volumes that are not composited
        (maximum intensity, ...), and for RGBA or several independent fields. Warns of what is left
        out: surfaces, shading, opacity by gradient.
        """
        volume = self._volume(volume)
        mesh, transfer = _data(volume), _look(volume)
        return mesh, Camera.from_vtk(self._plotter, dtype=mesh.dtype), transfer

    def render(self, volume: Any = None, **options: Any) -> jax.Array:
        """The scene as a float image (height, width, 4), premultiplied linear RGBA.

        volume: as for `scene`. options: of `jaxvr.render`; without a background it is transparent.
        """
        return render(*self.scene(volume), **_plain(options))

    def screenshot(
        self,
        filename: str | os.PathLike[str] | None = None,
        transparent_background: bool = False,
        volume: Any = None,
        **options: Any,
    ) -> np.ndarray:
        """The scene as the plotter's own `screenshot` gives it, drawn by jaxvr.

        filename: a file to write too, as `jaxvr.save_image` does.
        transparent_background: leave out the renderer's background.
        volume: as for `scene`. options: of `jaxvr.render`, but background.

        Returns (height, width, 3) uint8, or (height, width, 4) with straight alpha if transparent.
        """
        if "background" in options:
            raise ValueError("The background is the plotter's: set it with set_background.")
        image = self.render(volume, **options)
        if not transparent_background:
            image = _over_background(image, self._plotter.renderer)
        drawn = pixels(image)
        if filename is not None:
            save_image(filename, drawn)
        return drawn

    def _volume(self, chosen: Any) -> Any:
        props = self._plotter.renderer.GetViewProps()
        shown = [p for p in (props.GetItemAsObject(i) for i in range(props.GetNumberOfItems()))]
        shown = [p for p in shown if p.GetVisibility()]
        volumes = [p for p in shown if p.IsA("vtkVolume")]
        surfaces = [p for p in shown if p.IsA("vtkActor")]
        if chosen is None:
            if len(volumes) != 1:
                count = "no volume" if not volumes else f"{len(volumes)} volumes"
                raise ValueError(
                    f"The plotter's active renderer shows {count}, and jaxvr draws one. Add it "
                    "with add_volume; of several pass volume= what that returned."
                )
            (chosen,) = volumes
        elif not (hasattr(chosen, "IsA") and chosen.IsA("vtkVolume")):
            raise ValueError(
                f"volume must be what add_volume returned, but is a {type(chosen).__name__}."
            )
        others = len(volumes) - any(v is chosen for v in volumes)
        counts = {"surface(s)": len(surfaces), "other volume(s)": others}
        left = [f"{n} {what}" for what, n in counts.items() if n]
        if left:
            _tell(f"jaxvr draws one volume alone: {' and '.join(left)} of the plotter left out.")
        return chosen

    def __repr__(self) -> str:
        return "jaxvr on a plotter: scene, render, screenshot"


def _plain(options: dict[str, Any]) -> dict[str, Any]:
    if "status" in options:
        raise ValueError("There is no option status here: what the status bits say is raised.")
    return options


def _tell(message: str) -> None:
    warnings.warn(message, UserWarning, stacklevel=4)


def _data(volume: Any) -> TetMesh:
    """The mesh that a vtkVolume shows, in the world."""
    mapper: Any = volume.GetMapper()
    data = mapper and mapper.GetDataSetInput()
    if not data:
        raise ValueError("The volume has no data: its mapper has no input.")
    mode = mapper.GetScalarMode()
    location = {1: "point", 2: "cell", 3: "point", 4: "cell"}.get(mode)
    field = mapper.GetArrayName() or None if mode in (3, 4) else None
    nearest = volume.GetProperty().GetInterpolationType() == 0
    dual = _dual(data, field, location) if nearest else None
    if dual is None:
        mesh = TetMesh.from_pyvista(data, field, location=location)
    else:
        mesh = TetMesh.from_pyvista(dual, location="cell")
    matrix = volume.GetMatrix()
    if not matrix.IsIdentity():
        m = np.array([[matrix.GetElement(i, j) for j in range(4)] for i in range(4)])
        points = mesh.absolute_points() @ m[:3, :3].T + m[:3, 3]
        mesh = dataclasses.replace(mesh, origin=NOWHERE).replace(points=points)
    return mesh


def _dual(data: Any, field: str | None, location: str | None) -> Any:
    """A grid with a cell round each point of image data or of a rectilinear grid, up to the middle
    between points: what the nearest point's value looks like. None for other data, which VTK always
    interpolates, and for cell data."""
    import pyvista

    array = data.GetPointData().GetArray(field) if field else data.GetPointData().GetScalars()
    if location == "cell" or array is None or not array.GetName():
        return None
    if data.IsA("vtkImageData"):
        low = data.GetExtent()[::2]
        axes = [np.arange(n) + float(first) for n, first in zip(data.GetDimensions(), low)]
        m = data.GetIndexToPhysicalMatrix()
        matrix = np.array([[m.GetElement(i, j) for j in range(4)] for i in range(4)])
    elif data.IsA("vtkRectilinearGrid"):
        coordinates = data.GetXCoordinates(), data.GetYCoordinates(), data.GetZCoordinates()
        axes = [np.asarray(pyvista.convert_array(c), np.float64) for c in coordinates]
        matrix = np.eye(4)
    else:
        return None
    if min(map(len, axes)) < 2 or data.HasAnyBlankPoints() or data.HasAnyBlankCells():
        return None
    edges = [np.concatenate([x[:1], (x[1:] + x[:-1]) / 2, x[-1:]]) for x in axes]
    grid = pyvista.RectilinearGrid(*edges).cast_to_structured_grid()
    grid.points = np.asarray(grid.points) @ matrix[:3, :3].T + matrix[:3, 3]
    grid.cell_data[array.GetName()] = np.asarray(pyvista.convert_array(array))
    grid.set_active_scalars(array.GetName(), preference="cell")
    return grid


def _look(volume: Any) -> TransferFunction:
    """The transfer function of a vtkVolume."""
    mapper, look = volume.GetMapper(), volume.GetProperty()
    planes = mapper.GetClippingPlanes()
    if mapper.GetBlendMode() != 0:
        raise ValueError(
            "The volume is not composited (its blending is another one), and jaxvr does nothing "
            'else: add it with blending="composite".'
        )
    if not look.GetIndependentComponents():
        raise ValueError("The volume shows RGBA values; jaxvr maps one scalar field to colours.")
    left = [
        name
        for name, on in (
            ("shading", look.GetShade()),
            ("opacity by gradient", not look.GetDisableGradientOpacity() and _by_gradient(look)),
            ("clipping planes", planes is not None and planes.GetNumberOfItems() > 0),
            ("cropping", getattr(mapper, "GetCropping", int)()),
        )
        if on
    ]
    if left:
        _tell(f"jaxvr has no {' and no '.join(left)}: left out.")
    transfer = TransferFunction.from_vtk(volume)
    if mapper.IsA("vtkUnstructuredGridVolumeMapper"):
        return transfer
    # On image data and rectilinear grids an opacity means something else: see `from_opacity`.
    unit = look.GetScalarOpacityUnitDistance()
    opacities = np.asarray(transfer.extinctions, np.float64) * unit
    return TransferFunction.from_opacity(
        transfer.absolute_positions(),
        transfer.colors,
        np.clip(opacities, 0, 1).astype(transfer.positions.dtype),
        unit,
        "grid",
        max_opacity=OPAQUE,
        dtype=transfer.dtype,
    )


def _by_gradient(look: Any) -> bool:
    """Whether the opacity depends on the gradient, which it does where the function is not 1."""
    function = look.GetGradientOpacity()
    nodes = [[0.0] * 4 for _ in range(function.GetSize())]
    for k, node in enumerate(nodes):
        function.GetNodeValue(k, node)
    return any(node[1] != 1 for node in nodes)


def _over_background(image: jax.Array, renderer: Any) -> jax.Array:
    """Over the renderer's colour, or its two from the bottom to the top: RGB (H, W, 3)."""
    behind = np.array(renderer.GetBackground())
    if renderer.GetGradientBackground():
        rows = image.shape[0]
        part = (1 - (2 * np.arange(rows) + 1) / (2 * rows))[:, None, None]
        behind = behind + part * (np.array(renderer.GetBackground2()) - behind)
        behind = np.broadcast_to(behind, (*image.shape[:2], 3))
    return composite_over(image, behind)[..., :3]


def attach(pyvista: Any) -> None:
    """Gives PyVista's data and plotters their attribute `jaxvr`."""
    plotter = pyvista.BasePlotter
    if hasattr(pyvista, "register_dataset_accessor"):
        pyvista.register_dataset_accessor("jaxvr", pyvista.DataObject)(GridAccessor)
        pyvista.register_plotter_component("jaxvr", plotter)(PlotterComponent)
        return
    for target, made in ((pyvista.DataObject, GridAccessor), (plotter, PlotterComponent)):
        target.jaxvr = property(made)


def _import() -> Any:
    try:
        import pyvista
    except ImportError as error:
        raise ImportError("jaxvr.accessors is for PyVista: pip install pyvista") from error
    return pyvista


attach(_import())
