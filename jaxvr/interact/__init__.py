"""jaxvr in notebooks: pictures that show themselves, and volumes to be turned by hand.

`explore` opens a volume in a widget; `load_ipython_extension` (`%load_ext jaxvr`) shows images as
pictures. What is computed does not know of the widget: `orbit` is the camera as a hand moves it,
`edits` the transfer function as it is edited, `pace` how many pixels a moving picture may have,
`viewer` those three and the pictures. `widget` and `explorer.js` carry messages between them and
a browser. To add a gesture: a method of `Orbit` or an edit, and a line in `viewer` and in the
script.

Nothing here is imported by the rest of jaxvr, and anywidget (extra `notebooks`) only by `explore`.
"""

from jaxvr.interact.explorer import explore
from jaxvr.interact.ipython import load_ipython_extension, unload_ipython_extension

__all__ = ["explore", "load_ipython_extension", "unload_ipython_extension"]
