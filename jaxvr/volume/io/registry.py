"""Which readers take which file, and in which order; what is said where none of them reads it.

A file is known by its first bytes where its format has a mark, else by its suffix. VTK's readers
come first where VTK is installed, those without it after them; where one fails, the next is tried,
and a note says so.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

from . import exodus, gmsh, meshio_files, series, sizes, vtk_files
from .content import Ask, Content, Field, Trouble
from .fields import list_of

Reader = Callable[[Path, Ask, Callable[[], str], str], Content]

# Without VTK.
OWN: dict[str, list[Reader]] = {
    ".msh": [gmsh.read],
    ".e": [exodus.read],
}
# Where meshio knows more of the format, or VTK's reader does not end or crashes on healthy files.
_MESHIO_FIRST = {".dat", ".avs", ".xdmf"}
_OWN_FIRST = {".e"}  # VTK misreads some, without a word
NEED = {"h5py": "h5py", "netCDF4": "netCDF4", "vtkmodules": "vtk", "vtk": "vtk"}
# Suffixes that nobody here reads, and what does.
ELSEWHERE = {
    ".unv": "gmsh converts it: gmsh -3 FILE.unv -save -o FILE.msh",
    ".stl": "it holds a surface, not a volume",
    ".step": "it holds a shape, not a mesh: gmsh makes one",
    ".stp": "it holds a shape, not a mesh: gmsh makes one",
    ".geo": "it holds a shape, not a mesh: gmsh -3 FILE.geo makes one",
    ".h5": "say what is in it: an .xdmf file beside it, or FILE.vtkhdf as its name if it is one",
    ".npz": "load it by numpy.load and pass the arrays to TetMesh.from_cells",
    ".npy": "load it by numpy.load and pass the arrays to TetMesh.from_cells",
    ".frd": "convert it: pip install ccx2paraview",
    ".odb": "Abaqus alone reads it: write an .inp or .vtu file there",
    ".rst": "pip install ansys-mapdl-reader saves it as .vtu",
    ".cdb": "pip install ansys-mapdl-reader saves it as .vtu",
    ".plt": "binary Tecplot files are not read: save it as text (.dat)",
    ".xyz": "jaxvr.read_plot3d reads PLOT3D files",
    ".q": "jaxvr.read_plot3d reads PLOT3D files",
    ".p3d": "jaxvr.read_plot3d reads PLOT3D files",
}
_PACKED = {b"\x1f\x8b": "gunzip", b"BZh": "bunzip2", b"\xfd7zXZ": "unxz", b"PK\x03\x04": "unzip"}


def suffix_of(path: Path) -> str:
    """The suffix that stands for a file's format, by its first bytes where they tell."""
    with open(path, "rb") as f:
        head = f.read(400)
    text = head.lstrip()
    own = path.suffix.lower()
    own = vtk_files.SAME.get(own, own)
    for mark, tool in _PACKED.items():
        if head.startswith(mark) and own not in ELSEWHERE:
            raise Trouble("unsupported", f"it is packed: {tool} it first")
    if text.startswith(b"# vtk DataFile"):
        return ".vtk"
    if text.startswith(b"$MeshFormat"):
        return ".msh"
    if text.startswith((b"<?xml", b"<VTKFile")) and b"<VTKFile" in head:
        kinds = {
            b'"UnstructuredGrid"': ".vtu", b'"ImageData"': ".vti", b'"RectilinearGrid"': ".vtr",
            b'"StructuredGrid"': ".vts", b'"PolyData"': ".vtp", b'"PUnstructuredGrid"': ".pvtu",
            b'"PImageData"': ".pvti", b'"PRectilinearGrid"': ".pvtr",
            b'"PStructuredGrid"': ".pvts", b'"Collection"': ".pvd",
            b'"vtkMultiBlockDataSet"': ".vtm", b'"vtkPartitionedDataSet"': ".vtpd",
            b'"vtkPartitionedDataSetCollection"': ".vtpc",
        }  # fmt: skip
        for word, kind in kinds.items():
            if b"type=" + word in head:
                return kind
    return own


def fields(path: Path, ask: Ask, said: Callable[[], str]) -> tuple[list[Field], list[str]]:
    """The fields of a file, of all its steps, and what is to be told of them."""
    content = read(path, ask, said)
    found = list_of(content)
    suffix = suffix_of(path)
    if suffix not in series.SUFFIXES or len(content.steps) < 2:
        return found, []
    return series.fields(path, ask, said, suffix, read, found, content.step or 0)


def known() -> list[str]:
    """All suffixes that some reader takes."""
    import meshio

    own = [*vtk_files.READERS, *vtk_files.SAME, *OWN, *series.SUFFIXES]
    return sorted({*own, *meshio.extension_to_filetypes})


def _readers(suffix: str, vtk: bool) -> list[Reader]:
    found: list[Reader] = []
    if suffix in vtk_files.READERS and vtk:
        found.append(vtk_files.read)
    own = OWN.get(suffix, [])
    found = [*own, *found] if suffix in _OWN_FIRST else [*found, *own]
    import meshio

    if suffix in meshio.extension_to_filetypes and suffix not in OWN:
        found.insert(0 if suffix in _MESHIO_FIRST else len(found), meshio_files.read)
    elif suffix == ".msh":
        found.append(meshio_files.read)  # ANSYS Fluent's
    return found


def _is_gmsh(path: Path) -> bool:
    with open(path, "rb") as f:
        return f.read(40).lstrip().startswith(b"$")


def read(path: Path, ask: Ask, said: Callable[[], str]) -> Content:
    """The content of a file. Raises Trouble."""
    content = _read(path, ask, said)
    if ask.block is not None and not content.blocks:
        raise Trouble("asked", f"There is no block {ask.block!r}: it has no blocks with names")
    if ask.step is not None and content.step is None:
        times = sorted({t for each in content.field_steps.values() for t in each})
        several = any(len(each) > 1 for each in content.field_steps.values())  # chosen by field
        if not several and ask.step not in (0, -1, *times):
            has = f"one step, at {times[0]:g}" if times else "no time steps"
            raise Trouble("asked", f"There is no step {ask.step}: it has {has}")
    return content


def _read(path: Path, ask: Ask, said: Callable[[], str]) -> Content:
    suffix = suffix_of(path)
    if suffix in series.SUFFIXES:
        return series.read(path, ask, said, suffix, read)
    readers = [gmsh.read] if suffix == ".msh" and _is_gmsh(path) else _readers(suffix, ask.vtk)
    if not readers:
        raise Trouble("suffix", _unknown(path, suffix))
    if suffix == ".xdmf":
        _require_beside(path)
    counts = sizes.claims(path, suffix)
    missing: list[str] = []
    failed: list[Trouble] = []
    for reader in readers:
        try:
            content = reader(path, ask, said, suffix)
            sizes.require(content, counts, path)
        except ImportError as e:
            name = (e.name or str(e)).partition(".")[0]
            missing.append(NEED.get(name, name))
            continue
        except Trouble as e:
            if e.kind in ("asked", "large", "malformed"):
                raise
            failed.append(e)
            continue
        except MemoryError:
            raise
        except Exception as e:
            text = " ".join(str(e).split())[:200]
            failed.append(Trouble("damaged", f"{type(e).__name__}: {text}"))
            continue
        if failed:
            content.notes.append(f"{content.reader} read what another reader refused: {failed[0]}.")
        return content
    if missing:
        raise _missing(missing, failed)
    kinds = [e for e in failed if e.kind == "unsupported"]
    raise (
        (kinds or failed)[0]
        if len(failed) == 1 or kinds
        else Trouble("damaged", "; ".join(dict.fromkeys(e.message for e in failed)))
    )


def _require_beside(path: Path) -> None:
    """Trouble where files that an XDMF file names are not there: VTK's reader crashes then."""
    text = path.read_text("utf-8", "replace")
    for name in dict.fromkeys(re.findall(r">\s*([^<>\s][^<>:\n]*?\.h(?:5|df5?)):/", text)):
        if not (path.parent / name).is_file():
            series = " (of a time series)" if "Temporal" in text else ""
            raise Trouble("damaged", f"its numbers are in {name!r}{series}, which is not there")


def _missing(packages: list[str], failed: list[Trouble]) -> Trouble:
    names = [*dict.fromkeys(packages)]
    other = f" Without it: {failed[0]}." if failed else ""
    return Trouble(
        "package",
        f"it takes the package {' or '.join(names)}, which is not installed: "
        f"pip install {names[0]}.{other}",
    )


def _unknown(path: Path, suffix: str) -> str:
    if suffix in ELSEWHERE:
        return f"files with the suffix {suffix!r} are not read: {ELSEWHERE[suffix]}."
    what = f"the suffix {suffix!r} is unknown" if suffix else "its name has no suffix"
    return (
        f"{what}, and its first bytes do not tell its format. Suffixes that are read: "
        f"{' '.join(known())}. If another program reads it, save it as .vtu there."
    )
