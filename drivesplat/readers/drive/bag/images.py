"""Images and calibrations of ROS as image files and cameras of drive folders."""

from dataclasses import dataclass
from io import BytesIO
from typing import Any

import cv2
import numpy as np
from PIL import Image

from drivesplat.errors import DatasetError
from drivesplat.io.jpeg import encoded_jpeg
from drivesplat.readers.drive.bag.bag_map import Calibration
from drivesplat.readers.drive.format import Distortion
from drivesplat.readers.record_names import shown
from drivesplat.scene.images import DECODING_ERRORS

RAW_IMAGE, COMPRESSED_IMAGE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
JPEG_BEGIN, JPEG_END, TAIL = b"\xff\xd8\xff", b"\xff\xd9", 4096
"""How JPEG files begin and end, and in how many last bytes the end is searched: cameras pad files."""
MAX_SIDE = 20_000
ENCODINGS: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, None),
    "8UC1": (1, None),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2RGB),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
}
"""Bytes of a pixel, and OpenCV's code of the conversion to RGB."""
LENSES = {
    "plumb_bob": ("opencv", (4, 5)),
    "rational_polynomial": ("opencv", (8, 12, 14)),
    "equidistant": ("fisheye", (4,)),
    "fisheye": ("fisheye", (4,)),
}
"""ROS's models of distortion as those of drive folders, and their numbers of coefficients."""


@dataclass(frozen=True, eq=False)
class EncodedImage:
    """The content of an image file: `suffix`, bytes, width and height in pixels, and whether it has no colours."""

    suffix: str
    data: bytes
    size: tuple[int, int]
    grey: bool


def image_file(message: Any, raw: str) -> EncodedImage:
    """An Image or CompressedImage as a file. JPEG and PNG files stay what they are; other images become `raw`, png or
    jpeg. Raises DatasetError, the end of a sentence, where it is damaged or has more than 8 bits."""
    if hasattr(message, "format"):
        return _of_compressed(message.format, bytes(message.data), raw)
    return _encoded(_pixels(message), raw)


def _of_compressed(form: str, data: bytes, raw: str) -> EncodedImage:
    inside = form.rpartition("compressed")[2].strip() if ";" in form else ""
    if "compressedDepth" in form:
        raise DatasetError("is an image of depths; map a topic of colours")
    if data.startswith(JPEG_BEGIN) and JPEG_END not in data[-TAIL:]:
        raise DatasetError("is a truncated JPEG")
    try:
        with Image.open(BytesIO(data)) as image:
            size, mode, kind = image.size, image.mode, image.format
            if mode.startswith(("I", "F")):
                raise DatasetError(f"has more than 8 bits per channel ({mode}); convert the images to 8 bits")
            mosaic = inside.startswith("bayer") and mode == "L"
            if kind in ("JPEG", "PNG") and not mosaic:
                image.draft("RGB", (max(1, size[0] // 8), max(1, size[1] // 8)))
                image.load()
                return EncodedImage(".jpg" if kind == "JPEG" else ".png", data, size, mode in ("L", "1", "LA"))
            pixels = np.asarray(image.convert("L" if mode == "L" else "RGB"))
    except DECODING_ERRORS as error:
        raise DatasetError(f"cannot be decoded ({' '.join(str(error).split())[:100]})") from None
    return _encoded(cv2.cvtColor(pixels, _encoding(inside)[1]) if mosaic else pixels, raw)


def _encoding(name: str) -> tuple[int, int | None]:
    if name not in ENCODINGS:
        raise DatasetError(
            f"has the encoding {shown(name)}; images have one of {', '.join(ENCODINGS)}: convert it with image_proc or "
            "cv_bridge"
        )
    return ENCODINGS[name]


def _pixels(message: Any) -> np.ndarray:
    """The pixels (h, w, 3) or (h, w) of an Image."""
    channels, code = _encoding(message.encoding)
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = channels * width
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise DatasetError(f"is {width}x{height} pixels")
    if step < row or len(message.data) < step * (height - 1) + row:
        raise DatasetError(f"has {len(message.data)} bytes, too few for {width}x{height} pixels of {message.encoding}")
    rows = np.lib.stride_tricks.as_strided(message.data.view(np.uint8), (height, row), (step, 1), writeable=False)
    pixels = rows.reshape(height, width, channels) if channels > 1 else rows
    try:
        return np.ascontiguousarray(pixels) if code is None else cv2.cvtColor(np.ascontiguousarray(pixels), code)
    except cv2.error:
        raise DatasetError(f"of {width}x{height} pixels cannot be converted from {message.encoding}") from None


def _encoded(pixels: np.ndarray, raw: str) -> EncodedImage:
    """Pixels (h, w, 3) RGB or (h, w) as a file."""
    size, is_grey = (pixels.shape[1], pixels.shape[0]), pixels.ndim == 2
    if raw != "png":
        return EncodedImage(".jpg", encoded_jpeg(pixels), size, is_grey)
    file = BytesIO()
    Image.fromarray(pixels).save(file, format="PNG", compress_level=1)
    return EncodedImage(".png", file.getvalue(), size, is_grey)


def calibration_of(message: Any, rectified: bool) -> tuple[Calibration, np.ndarray]:
    """The calibration of a CameraInfo for the images as they are stored, binned and cut out, and the rotation (3, 3)
    of the camera's frame to that of its images: R where images are `rectified`, otherwise the identity.

    ROS 1 has capital names. Raises DatasetError, the end of a sentence, where it is none.
    """
    K, D, R, P = (
        np.asarray(getattr(message, name, getattr(message, name.upper(), ())), dtype=np.float64) for name in "kdrp"
    )
    if not (len(K) == len(R) == 9 and len(P) == 12) or not np.isfinite([*K, *D, *R, *P]).all():
        raise DatasetError("has numbers that are not finite")
    K, turn = K.reshape(3, 3), np.eye(3)
    model, coefficients = str(message.distortion_model), D.tolist()
    if rectified:
        K, turn, coefficients = P.reshape(3, 4)[:, :3], R.reshape(3, 3), []
        if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-3 or np.linalg.det(turn) < 0:
            raise DatasetError("has an R that is no rotation; rectified images need it")
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        raise DatasetError(f"has no focal length in {'P' if rectified else 'K'}: the camera is not calibrated")
    K = K / K[2, 2] if K[2, 2] else K
    region = message.roi
    size = np.array([region.width or message.width, region.height or message.height])
    binning = np.array([max(1, message.binning_x), max(1, message.binning_y)])
    K = K.copy()
    K[:2, 2] = (K[:2, 2] - [region.x_offset, region.y_offset] + 0.5) / binning - 0.5
    K[0, :2] /= binning[0]
    K[1, 1] /= binning[1]
    width, height = (int(value) for value in size // binning)
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise DatasetError(f"says that images are {width}x{height} pixels")
    rows = tuple(tuple(float(value) for value in row) for row in K)
    return Calibration(width=width, height=height, K=rows, distortion=_distortion(model, coefficients)), turn


def _distortion(model: str, coefficients: list[float]) -> Distortion:
    if not any(coefficients):
        return Distortion()
    if model not in LENSES:
        raise DatasetError(
            f"has the distortion model {shown(model)}, which is none of {', '.join(LENSES)}: state the calibration of "
            "the camera in the map"
        )
    lens, counts = LENSES[model]
    fitting = [count for count in counts if count <= len(coefficients) and not any(coefficients[count:])]
    if not fitting:
        raise DatasetError(
            f"has {len(coefficients)} coefficients of {model}, which has {' or '.join(map(str, counts))}"
        )
    return Distortion(model=lens, coefficients=tuple(coefficients[: fitting[-1]]))
