"""Pictures and plots with matplotlib, for notebooks and files.

    plot.image(jaxvr.render(mesh, camera, transfer), transfer=transfer)
    plot.transfer(transfer, values=mesh).savefig("transfer.png")

Every function draws on the axes it is given (`ax`, or `axes` for several) and returns them. Without
any it makes new ones, which a notebook shows and whose `savefig(path)` writes the figure they are
on; that is their `figure`. No display is needed, and pyplot is neither imported nor changed.

Lines and text have the colours of the axes: those of matplotlib's rcParams when these were made, so
that a style makes all of it light or dark; `dark()` is one. Images are premultiplied linear RGBA
(H, W, 4), as `render` returns them, opaque RGB (H, W, 3), or bytes. They are shown as they are, as
`jaxvr.save_image` writes them; with `srgb=True` linear light is coded as sRGB first.

Every `title` stands above the axes; None leaves it out.

To add a plot: a function that takes `ax`, makes one by `axes.new_axes` or `axes.picture_axes` if it
is None, and draws in the colour `axes.ink(ax)`.
"""

from jaxvr.plot.axes import Figure, dark
from jaxvr.plot.curves import history, transfer, transfer_gradient
from jaxvr.plot.images import against, compare, image
from jaxvr.plot.maps import difference, gradient, k_map

__all__ = [
    "Figure",
    "against",
    "compare",
    "dark",
    "difference",
    "gradient",
    "history",
    "image",
    "k_map",
    "transfer",
    "transfer_gradient",
]
