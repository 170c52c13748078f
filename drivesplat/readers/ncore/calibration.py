"""Sensor models of NCore as cameras and LiDARs of a scene, with every value checked.

Principal points of pinhole and fisheye models count from the corner of the image, those of f-theta from the centre of
its first pixel, as scenes have them.
"""

import logging
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.readers.checks import (
    checked_beams,
    checked_intrinsics,
    checked_numbers,
    checked_readout,
    checked_size,
)
from drivesplat.scene.sensors import Camera, DistortionModel, Lidar

log = logging.getLogger(__name__)

HALF_PIXEL = 0.5
MAX_INTRINSIC = 1e6
MAX_CONSTANT = 1e-3
"""Largest constant of an f-theta polynomial, in radians or pixels, that is rounding."""
READOUT_DIRECTIONS = {
    "ROLLING_TOP_TO_BOTTOM": "down",
    "ROLLING_LEFT_TO_RIGHT": "right",
    "ROLLING_BOTTOM_TO_TOP": "up",
    "ROLLING_RIGHT_TO_LEFT": "left",
}
"""Directions by the names of NCore's `ShutterType`."""


def is_global(parameters: Any) -> bool:
    """Whether a camera's shutter is global."""
    return parameters.shutter_type.name == "GLOBAL"


def camera_of(name: str, parameters: Any, readout_s: float | None) -> Camera:
    """A camera by the parameters of its model; `readout_s` is the time of its frames from start to end. A windshield's
    distortion is not applied, which is logged. Raises DatasetError naming the camera for values that no lens has."""
    record = f"camera {name}"
    resolution = [int(size) for size in parameters.resolution.tolist()]
    size = checked_size(*resolution, record)
    model, k, distortion = _lens(record, parameters)
    checked_intrinsics(k * [[1, 0, 1], [0, 1, 1], [1, 1, 1]], record, size)
    if not np.isfinite(k).all():
        raise DatasetError(f"{record}: its camera matrix is not finite")
    if parameters.external_distortion_parameters is not None:
        log.warning(
            "%s: its images were taken through a windshield whose distortion (%s) is not applied", record,
            parameters.external_distortion_parameters.type(),
        )  # fmt: skip
    seconds = 0.0 if is_global(parameters) else readout_s
    seconds, direction = checked_readout(seconds, READOUT_DIRECTIONS.get(parameters.shutter_type.name), record)
    return Camera(name, *size, k, distortion, seconds, direction, model)


def _lens(record: str, parameters: Any) -> tuple[DistortionModel, np.ndarray, np.ndarray]:
    """The distortion model, K (3, 3) and the coefficients of a camera."""
    kind = parameters.type()
    if kind not in ("ftheta", "ideal-pinhole", "opencv-pinhole", "opencv-fisheye"):
        raise DatasetError(
            f"{record}: its camera model is {kind}; ftheta, ideal-pinhole, opencv-pinhole and opencv-fisheye are read"
        )
    x, y = _values(record, "principal point", parameters.principal_point, 2)
    if kind == "ftheta":
        return _ftheta(record, parameters, x, y)
    focal = _values(record, "focal length", parameters.focal_length, 2)
    k = np.array([[focal[0], 0.0, x - HALF_PIXEL], [0.0, focal[1], y - HALF_PIXEL], [0.0, 0.0, 1.0]])
    if kind == "ideal-pinhole":
        return "none", k, np.zeros(5)
    if kind == "opencv-fisheye":
        return "fisheye", k, _values(record, "radial coefficients", parameters.radial_coeffs, 4)
    radial = _values(record, "radial coefficients", parameters.radial_coeffs, 6)
    tangential = _values(record, "tangential coefficients", parameters.tangential_coeffs, 2)
    prism = _values(record, "thin prism coefficients", parameters.thin_prism_coeffs, 4)
    values = np.concatenate([radial[:2], tangential, radial[2:], prism])
    return ("opencv", k, values) if values.any() else ("none", k, np.zeros(5))


def _ftheta(record: str, parameters: Any, x: float, y: float) -> tuple[DistortionModel, np.ndarray, np.ndarray]:
    """An f-theta lens by its reference polynomial. Its linear term [[c, d], [e, 1]] maps the polynomial's radius along
    x and y to pixels: radii of a scene's lens are measured along x, so that they are c times as long."""
    backward = parameters.reference_poly.name == "PIXELDIST_TO_ANGLE"
    polynomial = parameters.pixeldist_to_angle_poly if backward else parameters.angle_to_pixeldist_poly
    constant, *powers = _values(record, "f-theta polynomial", polynomial, len(polynomial))
    if abs(constant) > MAX_CONSTANT:
        raise DatasetError(f"{record}: its f-theta polynomial has the constant {constant:g}; it must be 0")
    values = np.trim_zeros(np.array(powers), "b")
    c, d, e = _values(record, "linear term", parameters.linear_cde, 3)
    if not len(values) or not values[0] > 0:
        raise DatasetError(f"{record}: the f-theta polynomial must begin with 0 and a positive number")
    if not c > 0 or not c > d * e:
        raise DatasetError(f"{record}: its linear term [[{c:g}, {d:g}], [{e:g}, 1]] mirrors its images")
    values = values / c ** np.arange(1, len(values) + 1) if backward else values * c
    focal = (1.0 / values[0] if backward else values[0]) / c
    k = np.array([[focal * c, focal * d, x], [focal * e, focal, y], [0.0, 0.0, 1.0]])
    return ("radius_to_angle" if backward else "angle_to_radius"), k, values


def _values(record: str, column: str, values: np.ndarray, count: int) -> np.ndarray:
    return checked_numbers(values.astype(np.float64), count, MAX_INTRINSIC, record, column, "numbers")


def lidar_of(name: str, parameters: Any | None) -> Lidar:
    """A LiDAR, with the elevations of its rows where its model is known."""
    if parameters is None or parameters.type() != "row-offset-spinning":
        return Lidar(name)
    elevations = parameters.row_elevations_rad.astype(np.float64)
    return Lidar(name, *checked_beams(elevations, parameters.n_columns, f"LiDAR {name}"))
