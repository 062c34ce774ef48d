"""Where pictures are taken from, and pictures as arrays.

A camera is a frozen pytree of arrays in world units with the picture's size as structure. Its
`rays()` gives origins and unit directions (height, width, 3), row 0 on top, in the camera's dtype
and differentiable in every array; that is all the rest of jaxvr asks of a camera, so a new kind
(a fisheye, say) is a class with the same method in a file of its own. Images are premultiplied
linear RGBA (height, width, 4).
"""

from jaxvr.view.camera import Camera
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
