"""The lenses of cameras: the pixel at which each distortion model images a direction.

`Camera.distortion` holds, by `Camera.distortion_model`, of an image with the matrix K (f in pixels):

- opencv: k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, tauX, tauY]]]], as OpenCV's calib3d.
- fisheye: k1 to k4 of cv2.fisheye: radius f (a + k1 a³ + k2 a⁵ + k3 a⁷ + k4 a⁹) at the angle a to the optical axis.
- angle_to_radius: c1, c2, … of any number: radius c1 a + c2 a² + … in pixels, the angle in radians. WoodScape's
  radial_poly and NVIDIA's f-theta ("angle to pixel distance") without its constant 0.
- radius_to_angle: c1, c2, …: angle c1 r + c2 r² + … in radians at the radius r in pixels ("pixel distance to angle").
- mei: xi, k1, k2, p1, p2 of Mei and Rives (2007), as cv2.omnidir and KITTI-360's fisheyes.

Radii of the two polynomials are measured along x; K scales y by fy / fx. For these two K may also shear the image:
K[0, 1] / fx and K[1, 0] / fx are pixels along x and y for each pixel of the radius along y and x.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64
from numpy.polynomial import polynomial
from scipy.interpolate import RectBivariateSpline

from drivesplat.scene.sensors import Camera

POLYNOMIALS = ("angle_to_radius", "radius_to_angle")
STEPS, STEP = 8, 1e-4
"""Iterations of Newton's method for the direction of a pixel, and the step in radians of its differences."""
NODE_SPACING = 4
"""Pixels between those at which directions are searched."""
MAX_ERROR = 0.05
"""Pixels by which the image of a direction may miss its pixel; a farther one has no direction."""
SAMPLES = 20_000
"""Angles, or radii, at which the growth of the radius is tested and a polynomial inverted."""
COEFFICIENTS = {"none": (0,), "opencv": (4, 5, 8, 12, 14), "fisheye": (4,), "mei": (5,)}
"""The numbers of coefficients that a distortion model may have; a polynomial may have any number above 0."""
MAX_FOCAL_RATIO = 1.1
"""Maximum ratio between the focal length of K and that of a polynomial at the centre of the image."""


def central_intrinsics(camera: Camera) -> Float[np.ndarray, "3 3"]:
    """The matrix of the pinhole camera that images directions near the optical axis as this camera does, but for
    shear."""
    focal, k = camera.intrinsics[0, 0], camera.intrinsics.copy()
    k[[0, 1], [1, 0]] = 0.0
    values = np.zeros(1) if camera.distortion is None else camera.distortion
    if camera.distortion_model in POLYNOMIALS:
        focal = values[0] if camera.distortion_model == "angle_to_radius" else 1.0 / values[0]
    elif camera.distortion_model == "mei":
        focal /= 1.0 + values[0]
    k[[0, 1], [0, 1]] *= focal / camera.intrinsics[0, 0]
    return k


def image_axes(intrinsics: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "2 2"]:
    """The matrix that maps the offset of a pixel from the principal point, in units of the pixels along x, to that in
    the image: the identity for square pixels without shear."""
    return intrinsics[:2, :2] / intrinsics[0, 0]


def pixels_of(camera: Camera, rays: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """The pixels at which a camera images directions (x right, y down, z forward, of any length): OpenCV's, integer at
    pixel centres, also outside the image. NaN where it images none: behind a pinhole, and from the angle on at which
    the radius stops growing.

    >>> import numpy as np
    >>> from drivesplat.scene.lens import pixels_of
    >>> from drivesplat.scene.sensors import Camera
    >>> k = np.array([[300.0, 0.0, 640.0], [0.0, 300.0, 480.0], [0.0, 0.0, 1.0]])
    >>> camera = Camera("side", 1280, 960, k, np.array([300.0]), distortion_model="angle_to_radius")
    >>> pixels_of(camera, np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 0.0]])).round(1).tolist()
    [[875.6, 480.0], [640.0, 951.2]]
    """
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.hypot(rays[:, 0], rays[:, 1])
    angles = np.arctan2(across, rays[:, 2])
    tested, radii = radial_profile(camera)
    seen = angles <= tested[-1]
    k = camera.intrinsics
    if camera.distortion_model in ("none", "opencv", "mei"):
        values = np.zeros(4) if camera.distortion is None else camera.distortion
        xi, values = (values[0], values[1:]) if camera.distortion_model == "mei" else (0.0, values)
        flat = np.where(seen[:, None], rays + np.array([0.0, 0.0, xi]), [0.0, 0.0, 1.0])
        pixels = cv2.projectPoints(flat, np.zeros(3), np.zeros(3), k, values)[0].reshape(-1, 2)
    else:
        along = rays[:, :2] / np.maximum(across, 1e-12)[:, None]
        radius = np.interp(angles, tested, radii)
        pixels = (radius[:, None] * along) @ image_axes(k).T + k[:2, 2]
    return np.where(seen[:, None], pixels, np.nan)


def directions(camera: Camera) -> Float64[np.ndarray, "h w 3"]:
    """The unit direction of every pixel of a distorted camera (x right, y down, z forward); NaN where it has none.

    They are searched at every NODE_SPACING-th pixel and interpolated between. Near nodes without a direction every
    pixel is searched.
    """
    size = np.array([camera.width, camera.height])
    x, y = (np.arange(-NODE_SPACING, edge + 2 * NODE_SPACING, NODE_SPACING) for edge in size)
    nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float64)
    turns, found = _turns(camera, nodes)
    shape = len(y), len(x)
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    dense = np.stack(
        [RectBivariateSpline(y, x, turns[:, i].reshape(shape))(np.arange(size[1]), np.arange(size[0])) for i in (0, 1)],
        axis=-1,
    ).reshape(-1, 2)
    missed = cv2.dilate((~found).reshape(shape).astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)
    pixels = np.stack([columns, rows], axis=-1).reshape(-1, 2).astype(np.float64)
    at_node = (pixels // NODE_SPACING).astype(int) + 1
    exact = missed[at_node[:, 1], at_node[:, 0]]
    rays = _turned(dense)
    if exact.any():
        turns, found = _turns(camera, pixels[exact])
        rays[exact] = np.where(found[:, None], _turned(turns), np.nan)
    return rays.reshape(camera.height, camera.width, 3)


def _turns(
    camera: Camera, pixels: Float64[np.ndarray, "n 2"]
) -> tuple[Float64[np.ndarray, "n 2"], Bool[np.ndarray, " n"]]:
    """The angles (radians) by which the optical axis is turned to the right and down towards pixels, and whether a
    pixel has such a direction."""
    across = np.linalg.solve(image_axes(camera.intrinsics), (pixels - camera.intrinsics[:2, 2]).T).T
    radius = np.linalg.norm(across, axis=1)
    known, radii = radial_profile(camera)
    angles = np.interp(radius, radii, known)
    turns = angles[:, None] * across / np.maximum(radius, 1e-12)[:, None]
    first = turns.copy()
    for _ in range(STEPS):
        found = pixels_of(camera, _turned(turns))
        by_x, by_y = (pixels_of(camera, _turned(turns + step)) for step in (np.array([STEP, 0.0]), [0.0, STEP]))
        (a, c), (b, d) = ((by_x - found) / STEP).T, ((by_y - found) / STEP).T
        determinant, (x, y) = a * d - b * c, (pixels - found).T
        with np.errstate(all="ignore"):
            change = np.stack([d * x - b * y, a * y - c * x], axis=1) / determinant[:, None]
        turns = turns + np.where(np.abs(determinant)[:, None] > 1e-9, change, 0.0)
    hit = np.linalg.norm(pixels_of(camera, _turned(turns)) - pixels, axis=1) < MAX_ERROR
    return np.where(hit[:, None], turns, first), hit


def _turned(turn: np.ndarray) -> np.ndarray:
    """The optical axis turned by angles (n, 2) in radians towards the right and down."""
    angle = np.linalg.norm(turn, axis=1, keepdims=True)
    return np.hstack([turn * np.sinc(angle / np.pi), np.cos(angle)])


def radial_profile(camera: Camera) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, " m"]]:
    """Angles to the optical axis (radians) from 0, and the radii in pixels along x at which the radial part of the lens
    images them: as far as the radius grows and is finite."""
    values = np.zeros(4) if camera.distortion is None else camera.distortion
    focal, model = camera.intrinsics[0, 0], camera.distortion_model
    with np.errstate(all="ignore"):
        if model == "radius_to_angle":
            radii = np.linspace(0.0, 4.0 * np.hypot(camera.width, camera.height), SAMPLES)
            angles = polynomial.polyval(radii, [0.0, *values])
        elif model == "angle_to_radius":
            angles = np.linspace(0.0, np.pi, SAMPLES)
            radii = polynomial.polyval(angles, [0.0, *values])
        elif model == "fisheye":
            angles = np.linspace(0.0, np.pi, SAMPLES)
            radii = focal * angles * polynomial.polyval(angles**2, [1.0, *values])
        else:
            xi, values = (values[0], values[1:]) if model == "mei" else (0.0, values)
            angles = np.linspace(0.0, np.pi if xi else 0.5 * np.pi, SAMPLES, endpoint=False)
            depth = np.cos(angles) + xi
            flat = np.where(depth > 0, np.sin(angles) / depth, np.inf)
            above, below = [1.0, values[0], values[1], *values[4:5]], [1.0, *values[5:8]]
            radii = focal * flat * polynomial.polyval(flat**2, above) / polynomial.polyval(flat**2, below)
        grows = (np.diff(radii) > 0) & (np.diff(angles) > 0) & np.isfinite(radii[1:]) & (angles[1:] <= np.pi)
    end = 1 + int(np.argmin(grows)) if not grows.all() else SAMPLES
    return angles[:end], radii[:end]


def coefficients_fault(model: str, count: int) -> str | None:
    """What is wrong with `count` coefficients of a distortion model; None if nothing is."""
    expected = COEFFICIENTS.get(model)
    if expected is None and not count:
        return f"distortion {model} has no coefficients; it takes one for each power, from the first on"
    if expected is not None and count not in expected:
        return f"distortion {model} has {count} coefficients; it takes {' or '.join(map(str, expected))}"
    return None


def lens_fault(camera: Camera) -> str | None:
    """Why a lens cannot image what lies between the centre and the nearest edge of its images, as the end of a
    sentence; None if it can, or if it is a polynomial whose focal length is not that of K."""
    k, model = camera.intrinsics, camera.distortion_model
    first = camera.distortion[0] if camera.distortion is not None and len(camera.distortion) else 0.0
    if model in POLYNOMIALS and not first > 0:
        return (
            f"its distortion {model} begins with the coefficient {first:g}, which must be positive: coefficients are "
            "those of the first power, the second and so on, without a constant"
        )
    if model == "mei" and not first >= 0:
        return f"its distortion mei begins with xi = {first:g}, which must not be negative: xi, k1, k2, p1, p2"
    ratio = k[0, 0] / central_intrinsics(camera)[0, 0]
    if model in POLYNOMIALS and not 1.0 / MAX_FOCAL_RATIO < ratio < MAX_FOCAL_RATIO:
        return (
            f"K states a focal length of {k[0, 0]:g} pixels, and its distortion {model} one of {k[0, 0] / ratio:g} at "
            "the centre of the image: check that its coefficients are those of pixels and radians, and write its focal "
            "length into K"
        )
    scale = k[0, 0] / k[1, 1]
    edge = min(k[0, 2], camera.width - 1 - k[0, 2], scale * k[1, 2], scale * (camera.height - 1 - k[1, 2]))
    angles, radii = radial_profile(camera)
    if radii[-1] < edge and angles[-1] < np.radians(89.0):
        return (
            "its distortion folds: two directions within the image have one pixel; check the order of the "
            f"{model} coefficients"
        )
    return None
