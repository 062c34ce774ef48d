"""Images as PNG files, pixel for pixel."""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from jaxvr.files import pixels


def encode(image: Any, level: int = 6) -> bytes:
    """The bytes of a PNG file, eight bits a channel.

    image (H, W, 4): premultiplied linear RGBA, stored with straight alpha; where all of it is
    opaque the file has none. The numbers are taken as they are, as `jaxvr.plot` does. level: 0 to
    9, from fast to small; it is lossless always.
    """
    from PIL import Image  # matplotlib needs it too, but loading it takes a while

    image = np.asarray(image)
    opaque = bool((image[..., 3] == 1).all())
    out = io.BytesIO()
    Image.fromarray(pixels(image[..., :3] if opaque else image)).save(
        out, format="PNG", compress_level=level
    )
    return out.getvalue()
