"""Pictures: brightness and opacity of their pixels."""

import io
import warnings
from pathlib import Path

import numpy as np
from PIL import Image

from countersteer.errors import InputError
from countersteer.reading.content import read_bytes

MOST_PIXELS = 40_000_000
FORMATS = ("PNG", "PPM", "BMP", "JPEG")


def read_pixels(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Brightness (0 to 255) and whether it is opaque, of each pixel: (rows, columns), top first.

    Raises `InputError` if the file is no picture, or one of over `MOST_PIXELS`.
    """
    content = read_bytes(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of many pixels, and of odd palettes
            with Image.open(io.BytesIO(content), formats=FORMATS) as opened:
                width, height = opened.size
                if width * height > MOST_PIXELS:
                    raise InputError(f"{path}: {width} × {height} pixels, over {MOST_PIXELS}")
                if opened.mode.startswith("I"):  # 16 bits
                    return np.asarray(opened) / 257, np.ones((height, width), bool)
                channels = np.asarray(opened.convert("RGBA"))
                return np.mean(channels[..., :3], axis=-1), channels[..., 3] > 0
    except InputError:
        raise
    except Image.DecompressionBombError:
        raise InputError(f"{path}: over {MOST_PIXELS} pixels") from None
    except Exception as error:  # each of Pillow's formats fails in its own ways
        raise InputError(f"{path}: no picture that can be read") from error
