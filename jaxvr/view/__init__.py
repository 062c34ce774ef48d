"""Where pictures are taken from, and pictures as arrays.

`Camera` is a frozen pytree of arrays in world units with the picture's size as structure. Its
`rays()` gives origins and unit directions (height, width, 3), row 0 on top, in the camera's dtype
and differentiable in every array. With `width` and `height` that is all that pictures, segments and
fits ask of a camera (`HasRays`), so a new kind (a fisheye, say) is a class with these three; what
asks for more, as orders of faces and the viewer do, takes a `Camera` and says so. Images are
premultiplied linear RGBA (height, width, 4).
"""

from jaxvr.view.camera import Camera, HasRays
from jaxvr.view.images import (
    composite_over,
    linear_to_srgb,
    psnr,
    srgb_to_linear,
    ssim,
    to_uint8,
    unpremultiply,
)
from jaxvr.view.load import PictureWarning, load_image

__all__ = [
    "Camera",
    "HasRays",
    "PictureWarning",
    "composite_over",
    "linear_to_srgb",
    "load_image",
    "psnr",
    "srgb_to_linear",
    "ssim",
    "to_uint8",
    "unpremultiply",
]
