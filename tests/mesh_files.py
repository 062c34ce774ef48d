"""For tests on files of meshes: kinds by name, text, and reading without warnings."""

import warnings
from typing import Any

from experiments import file_formats, file_kinds
from jaxvr.volume import TetMesh, read_mesh

BY_NAME = {k.name: k for k in file_formats.KINDS}

# How a file of gmsh begins whose elements are of the physical groups 7 and 8.
MSH_OF_TWO_BLOCKS = """$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
2
3 7 "lower part"
3 8 "upper part"
$EndPhysicalNames
"""


def quietly(path: Any, *args: Any, **kwargs: Any) -> TetMesh:
    """The mesh, whatever it warns of."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return read_mesh(path, *args, **kwargs)


def volume(mesh: TetMesh) -> float:
    return file_kinds.volume_of(mesh).sum()
