"""VTK's unstructured ray caster on the scene that jaxvr renders (extra `peers`).

A fair scene: the same tetrahedra, float64 scalars, the same control points in the colour and the
opacity function, one ray a pixel, no automatic sample distance, the accurate ("linear") integrator.
VTK does not correct scalars for perspective, so the camera has to be orthographic. VTK pierces a
pixel at its lower left corner and draws row 0 at the bottom, so its camera is half a pixel off.
Of the shifts -1/2, 0, 1/2 and 1 pixel in x and y this one, 1/2 and 1/2, agrees best with quadrature
(bluntfin, 128 x 128: a mean of 0.0034, all others 0.0042 or more).

What is left comes from VTK's display, not from its rays. `Vtk.raw` gives the floats that VTK
integrates, and they agree with quadrature to 2.5e-5. The window shows that image as a texture
whose first texel's centre lies on the left edge of its rectangle and whose last one's on the right
edge: n texels over n pixels, stretched by n / (n - 1) and filtered linearly. `Vtk.displayed` does
the same to the truth, and then no pixel of that image is off by more than 0.008, two steps of 8
bits; before, 313 were off by more than 0.02.
"""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

import jaxvr

OFF = 0.02  # a pixel is off where a channel differs by more than this


def _vtk() -> tuple[Any, Any]:
    """VTK and its NumPy bridge."""
    vtk = importlib.import_module("vtk")
    vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_ERROR)  # it warns of a missing X
    return vtk, importlib.import_module("vtk.util.numpy_support")


class Vtk:
    """A mesh in VTK's ray caster: `show` a scene, `draw` it, look at its `image`."""

    def __init__(self, mesh: jaxvr.TetMesh, threads: int):
        vtk, numpy_support = _vtk()
        points, tets = np.asarray(mesh.points, float), _positive(mesh)
        grid, coordinates, cells = vtk.vtkUnstructuredGrid(), vtk.vtkPoints(), vtk.vtkCellArray()
        coordinates.SetData(numpy_support.numpy_to_vtk(points, deep=1))
        cells.SetData(4, numpy_support.numpy_to_vtkIdTypeArray(tets.ravel(), deep=1))
        scalars = numpy_support.numpy_to_vtk(np.asarray(mesh.values, float), deep=1)
        scalars.SetName("s")
        grid.SetPoints(coordinates)
        grid.SetCells(vtk.VTK_TETRA, cells)
        grid.GetPointData().SetScalars(scalars)
        self.scalars, self.keep = scalars, grid
        self.mapper = vtk.vtkUnstructuredGridVolumeRayCastMapper()
        self.mapper.SetInputData(grid)
        self.integrator = vtk.vtkUnstructuredGridLinearRayIntegrator()
        self.mapper.SetRayIntegrator(self.integrator)
        self.mapper.SetAutoAdjustSampleDistances(0)
        self.mapper.SetImageSampleDistance(1.0)
        self.mapper.SetIntermixIntersectingGeometry(0)
        self.mapper.SetNumberOfThreads(threads)
        self.volume, self.renderer = vtk.vtkVolume(), vtk.vtkRenderer()
        self.volume.SetMapper(self.mapper)
        self.renderer.AddVolume(self.volume)
        self.renderer.SetBackground(0, 0, 0)
        self.renderer.SetBackgroundAlpha(0)
        self.window = vtk.vtkRenderWindow()
        self.window.SetOffScreenRendering(1)
        self.window.SetMultiSamples(0)
        self.window.SetAlphaBitPlanes(1)
        self.window.AddRenderer(self.renderer)

    def show(self, camera: jaxvr.Camera, transfer: jaxvr.TransferFunction) -> None:
        """What `draw` draws from now on. camera: orthographic."""
        vtk, _ = _vtk()
        color, opacity = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
        nodes = (transfer.positions, transfer.colors, transfer.extinctions)
        for x, rgb, tau in zip(*(np.asarray(a, float) for a in nodes), strict=True):
            color.AddRGBPoint(x, *rgb)
            opacity.AddPoint(x, tau)
        look = vtk.vtkVolumeProperty()
        look.SetColor(color)
        look.SetScalarOpacity(opacity)
        look.SetScalarOpacityUnitDistance(1.0)
        look.ShadeOff()
        look.SetInterpolationTypeToLinear()
        self.volume.SetProperty(look)

        self.window.SetSize(camera.width, camera.height)
        self.size = (camera.height, camera.width)
        extent = np.asarray(camera.extent, float)
        right, true_up, _ = (np.asarray(v, float) for v in camera.basis())
        shift = 0.5 * extent / camera.height * (right + true_up)
        view = self.renderer.GetActiveCamera()
        view.SetParallelProjection(1)
        view.SetPosition(*(np.asarray(camera.eye, float) + shift))
        view.SetFocalPoint(*(np.asarray(camera.target, float) + shift))
        view.SetViewUp(*np.asarray(camera.up, float))
        view.SetParallelScale(float(extent) / 2)
        self.renderer.ResetCameraClippingRange()

    def draw(self) -> None:
        """Casts all rays anew."""
        self.integrator.Modified()
        self.window.Modified()
        self.window.Render()

    def image(self) -> np.ndarray:
        """What the window shows, (height, width, 4) in [0, 1], 8 bits, row 0 on top."""
        vtk, numpy_support = _vtk()
        grab = vtk.vtkWindowToImageFilter()
        grab.SetInput(self.window)
        grab.SetInputBufferTypeToRGBA()
        grab.ReadFrontBufferOff()
        grab.SetShouldRerender(0)
        grab.Update()
        pixels = numpy_support.vtk_to_numpy(grab.GetOutput().GetPointData().GetScalars())
        return pixels.reshape(*self.size, 4)[::-1] / 255.0

    def displayed(self, image: np.ndarray) -> np.ndarray:
        """An image as VTK's window would show it: see the module. Needs a `draw` before."""
        out = np.array(image, float)[::-1]
        part = tuple(
            slice(first, first + number)
            for first, number in zip(
                self.mapper.GetImageOrigin()[1::-1],
                self.mapper.GetImageInUseSize()[1::-1],
                strict=True,
            )
        )
        out[part] = _stretched(np.swapaxes(_stretched(out[part]), 0, 1)).swapaxes(0, 1)
        return out[::-1]

    def raw(self, pixels: np.ndarray) -> np.ndarray:
        """The floats that VTK integrates, (n, 4), for pixels (n, 2) as row and column; slow.

        VTK's own iterator and integrator, called one after the other as its mapper does.
        """
        vtk, _ = _vtk()
        iterator = self.mapper.GetRayCastFunction().NewIterator()
        iterator.SetBounds(0.0, 1.0)
        near, far = self.scalars.NewInstance(), self.scalars.NewInstance()
        length, out = vtk.vtkDoubleArray(), np.zeros((len(pixels), 4))
        for k, (row, column) in enumerate(pixels):
            iterator.Initialize(int(column), int(self.size[0] - 1 - row))
            rgba = [0.0] * 4
            while iterator.GetNextIntersections(None, length, self.scalars, near, far) > 0:
                self.integrator.Integrate(length, near, far, rgba)
            out[k] = rgba
        return out

    def agreement(self, truth: np.ndarray, samples: int = 1000) -> dict[str, Any]:
        """How the picture that was drawn differs from `truth` (height, width, 4).

        vtk_error, vtk_pixels_off: of the window, from the truth stretched as the window is.
        vtk_pixels_off_unstretched: from the truth itself. vtk_raw_error: the largest of VTK's
        floats, before the display, at random pixels.
        """
        shown = self.image()
        gap = np.abs(shown - self.displayed(truth)).max(-1)
        rng = np.random.default_rng(0)
        pixels = rng.integers(0, self.size, (samples, 2))
        raw = np.abs(self.raw(pixels) - truth[pixels[:, 0], pixels[:, 1]])
        return {
            "vtk_error": float(gap.max()),
            "vtk_pixels_off": int((gap > OFF).sum()),
            "vtk_pixels_off_unstretched": int((np.abs(shown - truth).max(-1) > OFF).sum()),
            "vtk_raw_error": float(raw.max()),
        }


def _stretched(image: np.ndarray) -> np.ndarray:
    """n rows (n, ...) as n pixels whose range is that of the rows' centres, linearly between."""
    n = len(image)
    place = (np.arange(n) + 0.5) * (n - 1) / n
    row = np.clip(place.astype(int), 0, max(n - 2, 0))
    part = (place - row).reshape(-1, *[1] * (image.ndim - 1))
    return (1 - part) * image[row] + part * image[np.minimum(row + 1, n - 1)]


def _positive(mesh: jaxvr.TetMesh) -> np.ndarray:
    """Cells (T, 4) as positively oriented VTK tetrahedra."""
    points, tets = np.asarray(mesh.points, float), np.asarray(mesh.cells).astype(np.int64)
    corner = points[tets]
    volume = np.einsum(
        "ti,ti->t",
        np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]),
        corner[:, 3] - corner[:, 0],
    )
    tets[volume < 0] = tets[volume < 0][:, [0, 1, 3, 2]]
    return tets
