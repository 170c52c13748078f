"""What a `recolour` step does to the colours of an actor: a linear map of red, green and blue.

A linear map applies to every spherical harmonic and to every coefficient of a colour that varies with time, so that
shading and highlights stay. The hue is therefore a rotation about the axis of greys, which equals that of HSV for
rotations by multiples of 120 degrees, and the saturation is the distance from that axis.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.settings.edit import Recolour

GREY = np.full(3, 1.0 / np.sqrt(3.0))
"""The direction of greys."""
MEAN = np.full((3, 3), 1.0 / 3.0)
"""Maps a colour to the grey of its mean."""


def color_matrix(change: Recolour) -> np.ndarray:
    """The matrix (3, 3) that maps RGB colours, as images encode them, to those after a step."""
    if change.colour is not None:
        return change.value * np.outer(change.colour, MEAN[0])
    turn = Rotation.from_rotvec(np.radians(change.hue) * GREY).as_matrix()
    return change.value * (MEAN + change.saturation * turn @ (np.eye(3) - MEAN))
