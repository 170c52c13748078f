"""Images and their pixel conventions, compared with pixels computed by hand."""

import io

import numpy as np
import pytest
from helpers.reference_rays import pixel_rays
from PIL import Image

from drivesplat.errors import DatasetError
from drivesplat.scene.images import continuous_intrinsics, project, read_image, read_mask, target_size
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Frame
from drivesplat.settings.images import ImageSettings


def frame(width: int = 1600, height: int = 900, cx: float = 799.5, cy: float = 449.5) -> Frame:
    """A camera whose integer coordinates are pixel centres, as in OpenCV and nuScenes."""
    k = np.array([[1000.0, 0.0, cx], [0.0, 1100.0, cy], [0.0, 0.0, 1.0]])
    return Frame("CAM_FRONT", 0, "", width, height, k, np.eye(4), np.eye(4), True, 0, "")


@pytest.mark.parametrize(
    ("recorded", "width", "size"),
    [
        ((1600, 900), None, (1600, 900)),
        ((1600, 900), 800, (800, 450)),
        ((1600, 900), 1600, (1600, 900)),
        ((1600, 900), 100, (100, 56)),
        ((640, 360), 1280, (1280, 720)),
        ((10_000, 10), 16, (16, 1)),
    ],
)
def test_images_keep_their_aspect_ratio(recorded, width, size):
    assert target_size(frame(*recorded), ImageSettings(width=width)) == size


def test_intrinsics_count_from_the_images_corner_and_scale_each_axis_separately():
    k = continuous_intrinsics(frame(cx=10.0, cy=20.0), (1600, 900))
    np.testing.assert_allclose(k, [[1000.0, 0.0, 10.5], [0.0, 1100.0, 20.5], [0.0, 0.0, 1.0]])
    k = continuous_intrinsics(frame(1600, 900), (100, 56))
    np.testing.assert_allclose(k[0], [1000.0 / 16, 0.0, 800.0 / 16])
    np.testing.assert_allclose(k[1], [0.0, 1100.0 * 56 / 900, 450.0 * 56 / 900])


def test_halving_maps_the_corner_between_four_pixels_to_the_centre_of_their_merged_pixel():
    """Pixels (6, 4), (7, 4), (6, 5), (7, 5) become (3, 2): their common corner (7, 5) becomes its centre (3.5, 2.5)."""
    corner = np.array([6.5, 4.5])  # OpenCV's coordinates of that corner: half way between the pixels' centres
    source = frame(16, 10, cx=3.0, cy=7.0)
    ray = np.linalg.inv(source.intrinsics) @ [*corner, 1.0]
    x, y, _ = continuous_intrinsics(source, (8, 5)) @ ray
    np.testing.assert_allclose([x, y], [3.5, 2.5], atol=1e-12)


def test_resizing_to_a_half_averages_blocks_of_four(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (12, 20, 3)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "image.png")
    blocks = pixels.reshape(6, 2, 10, 2, 3).astype(float).mean(axis=(1, 3))
    np.testing.assert_allclose(read_image(tmp_path / "image.png", (10, 6)), blocks, atol=0.51)


def encoded(format: str) -> bytes:
    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(noise).save(buffer, format)
    return buffer.getvalue()


BROKEN = [
    *(whole[: int(share * len(whole))] for whole in map(encoded, ("JPEG", "PNG")) for share in (0.0, 0.01, 0.3, 0.9)),
    b"not an image", b"\0" * 1000, b"\xff\xd8\xff\xe0" + b"\1" * 100, b"\x89PNG\r\n\x1a\n",
]  # fmt: skip
"""Truncated and foreign files."""


@pytest.mark.parametrize("read", [read_image, lambda path: read_mask(path, (64, 64))], ids=["image", "mask"])
def test_a_truncated_or_foreign_file_is_refused_naming_it(tmp_path, read):
    for content in BROKEN:
        (tmp_path / "cut.jpg").write_bytes(content)
        with pytest.raises(DatasetError, match=r"cut\.jpg"):
            read(tmp_path / "cut.jpg")


def test_a_damaged_png_is_read_or_refused_naming_it(tmp_path):
    whole = encoded("PNG")
    for position in range(8, 60):
        content = bytearray(whole)
        content[position] ^= 0xFF
        (tmp_path / "damaged.png").write_bytes(content)
        try:
            assert read_image(tmp_path / "damaged.png").dtype == np.uint8
        except DatasetError as error:
            assert "damaged.png" in str(error)


def test_labels_keep_their_values_when_a_mask_is_resized(tmp_path):
    labels = np.random.default_rng(0).choice(np.array([0, 3, 9], dtype=np.uint8), (6, 8))
    Image.fromarray(np.kron(labels, np.ones((3, 3), dtype=np.uint8))).save(tmp_path / "labels.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "labels.png", (8, 6)), labels)
    np.testing.assert_array_equal(np.unique(read_mask(tmp_path / "labels.png", (11, 7))), [0, 3, 9])
    Image.fromarray(np.array([[True, False]])).save(tmp_path / "sky.png")
    np.testing.assert_array_equal(read_mask(tmp_path / "sky.png", (2, 1)), [[255, 0]]), "black and white"


def test_a_mask_of_colours_or_more_than_8_bits_is_refused(tmp_path):
    for mode in ("RGB", "RGBA", "I;16", "I", "F", "CMYK"):
        content = np.random.default_rng(0).bytes(8 * 6 * {"RGB": 3, "I;16": 2}.get(mode, 4))
        Image.frombytes(mode, (8, 6), content).save(tmp_path / "mask.tif")
        with pytest.raises(DatasetError, match=r"mask\.tif has colours or more than 8 bits"):
            read_mask(tmp_path / "mask.tif", (8, 6))


def camera() -> np.ndarray:
    """A camera-to-world pose: at (5, -2, 1.5), looking along world y, its image's x along world x, y down."""
    return rigid(np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]), np.array([5.0, -2.0, 1.5]))


def test_projection_of_known_points():
    k = np.array([[100.0, 0.0, 50.0], [0.0, 120.0, 40.0], [0.0, 0.0, 1.0]])
    points = np.array([[5.0, 8.0, 1.5], [7.0, 8.0, 1.5], [5.0, 18.0, 3.5], [5.0, -7.0, 1.5]])
    pixels, depth = project(points, inverse(camera()), k)
    np.testing.assert_allclose(depth, [10.0, 10.0, 20.0, -5.0])
    np.testing.assert_allclose(pixels[:3], [[50.0, 40.0], [70.0, 40.0], [50.0, 28.0]])


@pytest.mark.parametrize("skew", [0.0, 3.0])
def test_a_point_along_a_pixels_ray_projects_to_that_pixels_centre(skew):
    k = np.array([[100.0, skew, 20.0], [0.0, 120.0, 11.0], [0.0, 0.0, 1.0]])
    rays = pixel_rays((40, 24), k, camera())
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1.0)
    pixels, depth = project((camera()[:3, 3] + 17.0 * rays).reshape(-1, 3), inverse(camera()), k)
    x, y = np.meshgrid(np.arange(40) + 0.5, np.arange(24) + 0.5)
    np.testing.assert_allclose(pixels, np.stack([x.ravel(), y.ravel()], axis=1), atol=1e-9)
    assert (depth > 0).all()
