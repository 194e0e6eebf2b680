"""A picture of the design domain as phi, whatever the grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mpmopt.errors import DesignError
from mpmopt.scene import Design, Scene


def looked_up(
    picture: NDArray[np.float64], scene: Scene, positions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The entry of a picture at each position.

    Parameters
    ----------
    picture : (rows, columns) array
        Rows from the top. It covers the rectangle around all `Design` regions, both halves of them
        if there is a mirror, in whatever resolution.
    scene : Scene
    positions : (D, 2) array

    Returns
    -------
    (D,) array

    Raises
    ------
    DesignError
        If the picture is empty, or there is no Design.
    """
    regions = [region for region in scene.body if isinstance(region, Design)]
    if not picture.size or not regions:
        raise DesignError(
            f"a picture of shape {picture.shape} for {len(regions)} Design regions shows nothing; "
            "give at least one of each"
        )
    left, low = np.min([region.lower for region in regions], axis=0)
    right, top = np.max([region.upper for region in regions], axis=0)
    shares = np.stack(
        [(top - positions[:, 1]) / (top - low), (positions[:, 0] - left) / (right - left)]
    )
    shape = np.array(picture.shape)[:, None]
    row, column = np.clip((shares * shape).astype(int), 0, shape - 1)
    return picture[row, column]
