"""Cameras of requests: from the parameters of a message to a camera that can be rendered, and back."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from drivesplat.drive.cameras import PoseableCamera
from drivesplat.serve.faults import ServiceError, as_service_errors, invalid
from drivesplat.serve.messages import wire

MAX_SIDE = 16_384
"""Largest width and height of an image in pixels."""
MAX_PIXELS = 16_777_216
"""Pixels of an image, and of what a lens is resampled from."""
FOCAL_RANGE = 0.01, 100.0
"""Focal lengths in image widths."""
MAX_CAMERAS = 64
"""Number of cameras that are kept."""
MAX_KEPT_BYTES = 2 << 30
"""Memory of the cameras that are kept. The directions of a lens take seconds to compute, and 14 bytes for each pixel,
50 with a rolling shutter."""
READOUTS = {
    wire.ShutterType.ROLLING_TOP_TO_BOTTOM: (0.0, 1.0),
    wire.ShutterType.ROLLING_BOTTOM_TO_TOP: (0.0, -1.0),
    wire.ShutterType.ROLLING_LEFT_TO_RIGHT: (1.0, 0.0),
    wire.ShutterType.ROLLING_RIGHT_TO_LEFT: (-1.0, 0.0),
    wire.ShutterType.GLOBAL: (0.0, 0.0),
}
"""The directions, along x and y, in which shutters read an image."""
Lens = dict[str, Any]
"""Arguments of `PoseableCamera`: K, distortion, distortion_model and max_angle."""


def camera_of(spec: Any, width: int, height: int, length_us: int) -> PoseableCamera:
    """The camera of a `CameraSpec` with images of a size in pixels, which may differ from that of the specification:
    the same field of view then has other pixels. A rolling shutter reads an image in `length_us`, the length of a
    frame. The exposure is that of the recorded camera `logical_id`, if there is one.

    Raises ServiceError: INVALID_ARGUMENT for what is no camera, RESOURCE_EXHAUSTED for images that are too large.
    """
    if spec.shutter_type not in READOUTS:
        raise invalid(
            f"shutter_type {spec.shutter_type} is none of {', '.join(f'{t.value} ({t.name})' for t in READOUTS)}"
        )
    for what, size in (("", (width, height)), ("camera_intrinsics: ", (spec.resolution_w, spec.resolution_h))):
        if not all(1 <= edge <= MAX_SIDE for edge in size):
            raise invalid(f"{what}resolution_w and resolution_h are {size[0]}x{size[1]}; they must be 1 to {MAX_SIDE}")
    if width * height > MAX_PIXELS:
        raise ServiceError("RESOURCE_EXHAUSTED", f"an image of {width}x{height} has more than {MAX_PIXELS} pixels")
    rolling = any(READOUTS[spec.shutter_type])
    return _kept.camera((spec.SerializeToString(deterministic=True), width, height, length_us if rolling else 0))


CameraKey = tuple[bytes, int, int, int]
"""What a camera is made of: a serialized `CameraSpec`, width and height in pixels, and the length of a frame in
microseconds, which is 0 without a rolling shutter."""


class KeptCameras:
    """The cameras that were used last: at most `max_count`, of at most `max_bytes`, and always the last one.

    A camera that makes place gives up the directions of its lens; a request that still has it computes them again when
    it is rendered. So the lenses of calls that wait are within the limit, too. Any thread may call `camera`.
    """

    def __init__(self, max_bytes: int = MAX_KEPT_BYTES, max_count: int = MAX_CAMERAS):
        self._max_bytes, self._max_count = max_bytes, max_count
        self._cameras: dict[CameraKey, tuple[PoseableCamera, int]] = {}  # the one used last is the last
        self._lock, self._computing = threading.Lock(), threading.Lock()

    @property
    def size(self) -> int:
        """Bytes of all cameras: of their specifications, and of the directions of their lenses."""
        return sum(size for _, size in self._cameras.values())

    def camera(self, key: CameraKey) -> PoseableCamera:
        """The camera of a key. Lenses are computed one at a time, and a lens that several threads ask for is computed
        once; cameras that are there do not wait. Raises ServiceError for what is no camera."""
        found = self._use(key)
        if found is None:
            found = _camera(*key)
            if found.distorted:
                with self._computing:
                    found = self._use(key) or found
                    self._keep(key, found, len(key[0]) + _lens_bytes(found))
            else:
                self._keep(key, found, len(key[0]))
        return found

    def _use(self, key: CameraKey) -> PoseableCamera | None:
        with self._lock:
            if key not in self._cameras:
                return None
            self._cameras[key] = self._cameras.pop(key)
            return self._cameras[key][0]

    def _keep(self, key: CameraKey, camera: PoseableCamera, size: int) -> None:
        with self._lock:
            self._cameras.pop(key, None)
            self._cameras[key] = camera, size
            while len(self._cameras) > 1 and (self.size > self._max_bytes or len(self._cameras) > self._max_count):
                dropped, _ = self._cameras.pop(next(iter(self._cameras)))
                vars(dropped).pop("faces", None)  # which is a cached property


_kept = KeptCameras()


def _camera(serialized: bytes, width: int, height: int, length_us: int) -> PoseableCamera:
    """A camera, without the directions of its lens."""
    spec = wire.CameraSpec.FromString(serialized)
    kind = spec.WhichOneof("camera_param")
    if kind is None:
        known = " or ".join(LENSES)
        raise invalid(f"camera_intrinsics has no lens of those that are supported: {known}")
    if spec.WhichOneof("external_distortion") is not None:
        raise invalid("bivariate_windshield_model_param is not supported: leave it out of camera_intrinsics")
    scale = np.array([width / spec.resolution_w, height / spec.resolution_h])
    param = getattr(spec, kind)
    numbers = [getattr(param, name) for name in ("principal_point_x", "principal_point_y", *_NUMBERS[kind])]
    lens = LENSES[kind](param, scale)
    if not (np.isfinite(numbers).all() and np.isfinite(lens["K"]).all() and np.isfinite(lens["distortion"]).all()):
        raise invalid(f"{kind} has numbers that are not finite")
    _require_sound(kind, lens["K"], width, height)
    readout = 1e-6 * length_us * np.array([*READOUTS[spec.shutter_type], 0.0])
    with as_service_errors():
        return PoseableCamera(width, height, **lens, exposure_of=spec.logical_id or None, readout_s=readout)


def _lens_bytes(camera: PoseableCamera) -> int:
    """Computes the directions of a lens, and returns the bytes that they take. Raises ServiceError for a lens without
    any, and for one that is resampled from too many pixels."""
    with as_service_errors():
        faces = camera.faces
    if sum(face.width * face.height for face in faces) > MAX_PIXELS:
        raise ServiceError(
            "RESOURCE_EXHAUSTED",
            f"the lens is resampled from more than {MAX_PIXELS} pixels: ask for a smaller image, or give it a smaller "
            "max_angle",
        )
    return sum(each.nbytes for face in faces for each in (face.shows, face.places, face.distance_by_depth))


_NUMBERS = {
    "opencv_pinhole_param": ("focal_length_x", "focal_length_y"),
    "opencv_fisheye_param": ("focal_length_x", "focal_length_y", "max_angle"),
    "ftheta_param": ("max_angle",),
}
"""Further numbers of each lens."""


def _require_sound(kind: str, K: np.ndarray, width: int, height: int) -> None:
    """Raises ServiceError for a focal length or a principal point that no camera has."""
    least, most = (factor * width for factor in FOCAL_RANGE)
    if not all(least <= focal <= most for focal in (K[0, 0], K[1, 1])):
        raise invalid(
            f"{kind}: the focal lengths are {K[0, 0]:g} and {K[1, 1]:g} pixels in images {width} pixels wide; they "
            f"must be {least:g} to {most:g}"
        )
    if not all(-10 * edge <= point <= 11 * edge for point, edge in zip(K[:2, 2], (width, height), strict=True)):
        raise invalid(
            f"{kind}: the principal point ({K[0, 2]:g}, {K[1, 2]:g}) is far from an image of {width}x{height}"
        )


def _pinhole(param: Any, scale: np.ndarray) -> Lens:
    k = _coefficients(param.radial_coeffs, 6, "radial_coeffs")
    p = _coefficients(param.tangential_coeffs, 2, "tangential_coeffs")
    s = _coefficients(param.thin_prism_coeffs, 4, "thin_prism_coeffs")
    distortion = [*k[:2], *p, *k[2:], *s]
    lens = {"distortion": np.array(distortion), "distortion_model": "opencv"} if any(distortion) else _NO_LENS
    return {"K": _scaled(param, scale), **lens}


_NO_LENS: Lens = {"distortion": np.zeros(0), "distortion_model": "none"}


def _fisheye(param: Any, scale: np.ndarray) -> Lens:
    k = _coefficients(param.radial_coeffs, 4, "radial_coeffs")
    lens = {"distortion": np.array(k), "distortion_model": "fisheye", "max_angle": _max_angle(param)}
    return {"K": _scaled(param, scale), **lens}


def _ftheta(param: Any, scale: np.ndarray) -> Lens:
    """The polynomials of drivesplat have no constant, and radii along x in pixels of the image. `linear_cde` maps
    radii to offsets from the principal point, in pixels of the specification: [[c, d], [e, 1]]."""
    backward = param.reference_poly == param.PIXELDIST_TO_ANGLE
    if not backward and param.reference_poly != param.ANGLE_TO_PIXELDIST:
        raise invalid("ftheta_param: reference_poly must be PIXELDIST_TO_ANGLE or ANGLE_TO_PIXELDIST")
    name = "pixeldist_to_angle_poly" if backward else "angle_to_pixeldist_poly"
    constant, *powers = [*getattr(param, name), 0.0]
    values = np.trim_zeros(np.array(powers), "b")
    if constant or not len(values) or len(values) > 16 or not values[0] > 0.0:
        raise invalid(
            f"ftheta_param: {name} must be 0 for the constant, then a positive number and others for up to 16 powers"
        )
    cde = param.linear_cde
    c, d, e = (cde.linear_c, cde.linear_d, cde.linear_e) if param.HasField("linear_cde") else (1.0, 0.0, 0.0)
    axes = np.array([[c, d], [e, 1.0]]) * scale[:, None]
    if not (np.isfinite(axes).all() and axes[0, 0] > 0.0):
        raise invalid(f"ftheta_param: linear_cde of {c:g}, {d:g}, {e:g} is none of a lens; without any it is 1, 0, 0")
    along_x = axes[0, 0]  # pixels for each pixel of the specification
    powers_of_x = along_x ** -np.arange(1.0, len(values) + 1.0) if backward else along_x
    distortion = values * powers_of_x
    focal = 1.0 / distortion[0] if backward else distortion[0]
    K = np.eye(3)
    K[:2, :2] = focal / along_x * axes
    K[:2, 2] = scale * [param.principal_point_x, param.principal_point_y]
    model = "radius_to_angle" if backward else "angle_to_radius"
    return {"K": K, "distortion": distortion, "distortion_model": model, "max_angle": _max_angle(param)}


LENSES: dict[str, Callable[[Any, np.ndarray], Lens]] = {
    "opencv_pinhole_param": _pinhole,
    "opencv_fisheye_param": _fisheye,
    "ftheta_param": _ftheta,
}
"""What makes a lens, at a scale (2,) along x and y, of each kind of parameters."""


def _coefficients(given: Sequence[float], count: int, name: str) -> list[float]:
    """The coefficients of a lens; those that are not given are 0."""
    if len(given) > count:
        raise invalid(f"camera_intrinsics: {name} has {len(given)} numbers; it takes up to {count}")
    return [*given, *[0.0] * (count - len(given))]


def _max_angle(param: Any) -> float | None:
    """The largest angle to the optical axis in radians that a lens images; None: as far as it can."""
    if not 0.0 <= param.max_angle < np.inf:
        raise invalid(f"camera_intrinsics: a max_angle of {param.max_angle:g} is no angle in radians")
    return min(param.max_angle, np.pi) or None


def _scaled(param: Any, scale: np.ndarray) -> np.ndarray:
    """K of a camera with focal lengths."""
    focal = scale * [param.focal_length_x, param.focal_length_y]
    centre = scale * [param.principal_point_x, param.principal_point_y]
    return np.array([[focal[0], 0.0, centre[0]], [0.0, focal[1], centre[1]], [0.0, 0.0, 1.0]])


def spec_of(camera: PoseableCamera, name: str) -> Any:
    """A pinhole camera as a `CameraSpec`; its shutter is that of `camera.readout_s`."""
    direction = tuple(np.sign(camera.readout_s[:2]))
    shutter = next(kind for kind, along in READOUTS.items() if along == direction)
    K = camera.K.tolist()
    lens = wire.OpenCVPinholeCameraParam(
        principal_point_x=K[0][2], principal_point_y=K[1][2], focal_length_x=K[0][0], focal_length_y=K[1][1]
    )
    return wire.CameraSpec(
        opencv_pinhole_param=lens, logical_id=name, resolution_w=camera.width, resolution_h=camera.height,
        shutter_type=shutter,
    )  # fmt: skip
