"""Files of meshes: which reader takes which file, and the process in which all of them run.

Readers of other packages print, change warnings, wait for ever behind the end of a file, ask for
gigabytes and crash. None of that may reach the caller's process, whose streams, warnings and memory
are shared by all its threads; so files are read and written in processes of their own (`process`
starts them and keeps a few, `child` is what runs there), and what comes back is arrays.

A reader is a function from a path and an `Ask` to a `Content` (`content`): points, cells by type
and block, fields, steps. `registry` says which readers take a file, by its first bytes and its
suffix, and in which order: VTK's (`vtk_files`, `vtk_data`) where the package is installed, gmsh's
format (`gmsh`), Exodus on netCDF (`exodus`), meshio's (`meshio_files`); `series` has those that
list other files. `sizes` compares the counts
that a file claims with its size before anybody reads it, and with what came out afterwards.
`polyhedra` cuts what is no cell of the zoo. `fields` chooses a field. `write` writes. `jobs` is
what the process is asked for.

To add a format: a reader here, and a line in `registry`. It raises `Trouble`, which says whether a
file is damaged, of a kind that is not supported, in need of a package or too large, and leaves
nothing out without a note. Modules of this folder import NumPy and each other only, `cells` and
`weld` beside it: the process that reads never loads JAX.
"""
