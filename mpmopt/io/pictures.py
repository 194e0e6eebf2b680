"""Pictures from files."""

from __future__ import annotations

import os

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mpmopt.errors import DesignError


def read_picture(path: str | os.PathLike[str]) -> NDArray[np.float64]:
    """A picture as phi (rows from the top, columns): black is 1, white and clear are -1.

    Raises
    ------
    DesignError
        If there is no picture.
    """
    try:
        with Image.open(path) as image:
            coloured = image.convert("RGBA")
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        raise DesignError(f"{path} is no picture: {error}; give a PNG") from error
    paper = Image.new("RGBA", coloured.size, "white")
    grey = Image.alpha_composite(paper, coloured).convert("L")
    return 1.0 - np.asarray(grey, dtype=float) / 127.5
