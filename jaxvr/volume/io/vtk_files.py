"""Files that VTK's own readers take: a table from suffixes to classes, and what to switch on.

Where VTK prints an error, the file counts as damaged, whatever came out. Displacements are not
added to the points of Exodus files, and OpenFOAM's cell data are not averaged to points: what is in
the file is what is read.
"""

from __future__ import annotations

import contextlib
import importlib
import re
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from .content import Ask, Content, Trouble, pick_step
from .vtk_data import content_of

# suffix: module of vtkmodules, class
READERS = {
    ".vtu": ("vtkIOXML", "vtkXMLUnstructuredGridReader"),
    ".vti": ("vtkIOXML", "vtkXMLImageDataReader"),
    ".vtr": ("vtkIOXML", "vtkXMLRectilinearGridReader"),
    ".vts": ("vtkIOXML", "vtkXMLStructuredGridReader"),
    ".vtp": ("vtkIOXML", "vtkXMLPolyDataReader"),
    ".pvtu": ("vtkIOXML", "vtkXMLPUnstructuredGridReader"),
    ".pvti": ("vtkIOXML", "vtkXMLPImageDataReader"),
    ".pvtr": ("vtkIOXML", "vtkXMLPRectilinearGridReader"),
    ".pvts": ("vtkIOXML", "vtkXMLPStructuredGridReader"),
    ".vtm": ("vtkIOXML", "vtkXMLMultiBlockDataReader"),
    ".vtmb": ("vtkIOXML", "vtkXMLMultiBlockDataReader"),
    ".vtpd": ("vtkIOXML", "vtkXMLPartitionedDataSetReader"),
    ".vtpc": ("vtkIOXML", "vtkXMLPartitionedDataSetCollectionReader"),
    ".vtk": ("vtkIOLegacy", "vtkGenericDataObjectReader"),
    ".vtkhdf": ("vtkIOHDF", "vtkHDFReader"),
    ".hdf": ("vtkIOHDF", "vtkHDFReader"),
    ".cgns": ("vtkIOCGNSReader", "vtkCGNSReader"),
    ".e": ("vtkIOExodus", "vtkExodusIIReader"),
    ".case": ("vtkIOEnSight", "vtkGenericEnSightReader"),
    ".foam": ("vtkIOGeometry", "vtkOpenFOAMReader"),
    ".dat": ("vtkIOGeometry", "vtkTecplotReader"),
    ".neu": ("vtkIOGeometry", "vtkGAMBITReader"),
    ".cas": ("vtkIOGeometry", "vtkFLUENTReader"),
    ".avs": ("vtkIOGeometry", "vtkAVSucdReader"),
    ".xdmf": ("vtkIOXdmf2", "vtkXdmfReader"),
}
SAME = {
    ".ex2": ".e", ".exo": ".e", ".exii": ".e", ".g": ".e", ".encas": ".case", ".tec": ".dat",
    ".tp": ".dat", ".ucd": ".avs", ".xmf": ".xdmf",
}  # fmt: skip
_COMPOSITE = (".vtm", ".vtmb", ".vtpd", ".vtpc")
_TROUBLE = re.compile(r"(?:ERR\||ERROR: In|Error:|Generic Warning: In.*(?:[Ee]rror|[Uu]nable))")


def read(path: Path, ask: Ask, said: Callable[[], str], suffix: str) -> Content:
    """One of the files of `READERS`. Raises ImportError without VTK."""
    suffix = SAME.get(suffix, suffix)
    if suffix == ".e" and b"dim_nod_var" in path.read_bytes():
        # meshio's Exodus files: VTK takes other numbers for their values, without a word
        raise ImportError("netCDF4", name="netCDF4")
    module, name = READERS[suffix]
    reader = getattr(importlib.import_module(f"vtkmodules.{module}"), name)()
    if suffix == ".case":
        reader.SetCaseFileName(str(path))
    else:
        reader.SetFileName(str(path))
    if suffix == ".vtk":
        for what in (
            "Scalars",
            "Vectors",
            "Normals",
            "Tensors",
            "ColorScalars",
            "TCoords",
            "Fields",
        ):
            getattr(reader, f"ReadAll{what}On")()
    if suffix == ".dat":
        if not ask.alone:
            raise Trouble("unsupported", f"{name} may wait for ever, and cannot be ended here")
        _require_soon(2 + path.stat().st_size / 5e5)
    with _heard(ask.alone) as heard:
        reader.UpdateInformation()
        steps = _times(reader)
        _switch_on(reader, suffix)
        step = None
        if steps:
            step = pick_step(steps, ask.step)
            reader.UpdateTimeStep(steps[step])
        else:
            reader.Update()
        told = heard()
    if suffix == ".dat" and hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_PROF, 0)
    data = reader.GetOutputDataObject(0)
    told = " ".join((told + said()).split())
    found = _TROUBLE.search(told)
    if found:
        raise Trouble("damaged", f"{name}: {_plain(told[found.start() :])}")
    content = content_of(data, ask.block, ask.limit, path.name)
    content.reader = name
    content.raw = data.GetNumberOfPoints(), data.GetNumberOfCells()  # of all blocks
    content.steps = steps if len(steps) > 1 else ()
    content.step = step
    if suffix == ".vtk":
        content.active = []  # that is the last of those that were read
    if told:
        content.notes.append(f"{name} says: {_plain(told)}")
    return content


@contextlib.contextmanager
def _heard(alone: bool) -> Iterator[Callable[[], str]]:
    """What VTK says meanwhile, where this process is the caller's and its streams are left alone:
    a window of VTK's takes it, in the place of the caller's."""
    if alone:
        yield lambda: ""
        return
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow

    window, before = vtkStringOutputWindow(), vtkOutputWindow.GetInstance()
    vtkOutputWindow.SetInstance(window)
    try:
        yield window.GetOutput
    finally:
        vtkOutputWindow.SetInstance(before)


def _require_soon(seconds: float) -> None:
    """VTK's Tecplot reader waits for ever for what a file cut short does not have: it gets less
    time than others, after which this process is ended."""
    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_PROF, seconds)


def _plain(told: str) -> str:
    """VTK's messages without time stamps, addresses and places in its source."""
    told = re.sub(r"\(\s*[0-9.]+s\)\s*\[[^\]]*\]\s*", "", told)
    told = re.sub(r"(ERROR|Warning): In \S+\.cxx, line \d+", "", told)
    told = re.sub(r"\S+\.cxx:\d+\s*(ERR|WARN)\|\s*", "", told)
    told = re.sub(r"\((?:0x)?[0-9a-f]{6,}\)", "", told)
    return told[:300]


def _times(reader: Any) -> tuple[float, ...]:
    executive = reader.GetExecutive()
    information = executive.GetOutputInformation(0)
    key = executive.TIME_STEPS()
    return tuple(information.Get(key)) if information.Has(key) else ()


def _switch_on(reader: Any, suffix: str) -> None:
    """All that the file has, and nothing made of it."""
    if suffix == ".e":
        reader.ApplyDisplacementsOff()
        reader.GenerateObjectIdCellArrayOff()
        for kind in (reader.ELEM_BLOCK, reader.NODAL):
            for k in range(reader.GetNumberOfObjectArrays(kind)):
                reader.SetObjectArrayStatus(kind, reader.GetObjectArrayName(kind, k), 1)
        for k in range(reader.GetNumberOfObjects(reader.ELEM_BLOCK)):
            reader.SetObjectStatus(reader.ELEM_BLOCK, k, 1)
    elif suffix == ".foam":
        reader.CreateCellToPointOff()
        reader.EnableAllCellArrays()
        reader.EnableAllPointArrays()
    elif suffix == ".cgns":
        reader.EnableAllBases()
        reader.EnableAllFamilies()
        reader.EnableAllPointArrays()
        reader.EnableAllCellArrays()
    elif suffix in (".avs", ".dat", ".neu", ".cas", ".case", ".xdmf"):
        for what in ("Point", "Cell"):
            for k in range(getattr(reader, f"GetNumberOf{what}Arrays", int)()):
                name = getattr(reader, f"Get{what}ArrayName")(k)
                getattr(reader, f"Set{what}ArrayStatus")(name, 1)


def names(path: Path, suffix: str) -> set[tuple[str, str]] | None:
    """(name, location) of the arrays in a file of VTK's XML by its header; None for other files."""
    module, name = READERS.get(suffix, ("", ""))
    if module != "vtkIOXML" or suffix in _COMPOSITE:
        return None
    reader = getattr(importlib.import_module(f"vtkmodules.{module}"), name)()
    reader.SetFileName(str(path))
    reader.UpdateInformation()
    return {
        (getattr(reader, f"Get{what}ArrayName")(k), what.lower())
        for what in ("Point", "Cell")
        for k in range(getattr(reader, f"GetNumberOf{what}Arrays")())
    }
