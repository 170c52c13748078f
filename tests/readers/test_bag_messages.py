"""Messages of ROS: layouts of point clouds, encodings of images, calibrations, transforms."""

from io import BytesIO
from typing import Any

import numpy as np
import pytest
import yaml
from helpers.bags import K, Messages
from PIL import Image
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.readers.drive.bag.bag_map import BagLidar, PointTime
from drivesplat.readers.drive.bag.clouds import sweep_columns
from drivesplat.readers.drive.bag.images import calibration_of, image_file
from drivesplat.readers.drive.bag.layouts import cloud_layout
from drivesplat.readers.drive.bag.transforms import EgoTrack, FrameEdge, TransformTable, TransformTree, ego_track
from drivesplat.scene.rigid import rigid

MAKE = Messages()
STAMP = 1_700_000_000_123_456
"""Microseconds."""
SECONDS = np.array([0.0, 0.02, 0.05, 0.099])
POINTS = np.array([[5.0, 1, 2], [-6, 3, 0.5], [0.3, -8, 1], [40, 2, -1]])


def layout(step: int, **fields: tuple[str, int]) -> np.dtype:
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": step})


XYZ = {"x": ("<f4", 0), "y": ("<f4", 4), "z": ("<f4", 8)}
LAYOUTS: dict[str, tuple[np.dtype, dict[str, Any], dict[str, Any]]] = {
    "velodyne": (
        layout(32, **XYZ, intensity=("<f4", 16), ring=("<u2", 20), time=("<f4", 24)),
        {"intensity": 100.0, "ring": [0, 1, 2, 3], "time": SECONDS - 0.099},
        {"unit": "s", "counts_from": "stamp", "scale": 255.0, "first": -0.099},
    ),
    "ouster": (
        layout(48, **XYZ, intensity=("<f4", 16), t=("<u4", 20), reflectivity=("<u2", 24), ring=("<u2", 26)),
        {"intensity": 3000.0, "reflectivity": 100, "ring": [0, 1, 2, 3], "t": SECONDS * 1e9},
        {"unit": "ns", "counts_from": "stamp", "scale": 255.0, "first": 0.0},
    ),
    "hesai": (
        layout(26, **XYZ, intensity=("<f4", 12), timestamp=("<f8", 16), ring=("<u2", 24)),
        {"intensity": 100.0, "ring": [0, 1, 2, 3], "timestamp": STAMP * 1e-6 + SECONDS},
        {"unit": "s", "counts_from": "epoch", "scale": 255.0, "first": 0.0},
    ),
    "livox": (
        layout(26, **XYZ, intensity=("<f4", 12), tag=("u1", 16), line=("u1", 17), timestamp=("<f8", 18)),
        {"intensity": 100.0, "line": [0, 1, 2, 3], "timestamp": STAMP * 1e3 + SECONDS * 1e9},
        {"unit": "ns", "counts_from": "epoch", "scale": 255.0, "first": 0.0},
    ),
    "livox on another clock": (
        layout(26, **XYZ, intensity=("<f4", 12), tag=("u1", 16), line=("u1", 17), timestamp=("<f8", 18)),
        {"intensity": 100.0, "line": [0, 1, 2, 3], "timestamp": 5e12 + SECONDS * 1e9},
        {"unit": "ns", "counts_from": "start", "scale": 255.0, "first": 0.0},
    ),
    "livox offsets": (
        layout(20, **XYZ, offset_time=("<u4", 12), reflectivity=("u1", 16), line=("u1", 18)),
        {"reflectivity": 100, "line": [0, 1, 2, 3], "offset_time": SECONDS * 1e9},
        {"unit": "ns", "counts_from": "stamp", "scale": 255.0, "first": 0.0},
    ),
    "autoware": (
        layout(
            32, **XYZ, intensity=("u1", 12), return_type=("u1", 13), channel=("<u2", 14), azimuth=("<f4", 16),
            elevation=("<f4", 20), distance=("<f4", 24), time_stamp=("<u4", 28),
        ),
        {"intensity": 100, "channel": [0, 1, 2, 3], "time_stamp": SECONDS * 1e9},
        {"unit": "ns", "counts_from": "stamp", "scale": 255.0, "first": 0.0},
    ),
    "microseconds": (
        layout(20, **XYZ, time=("<f4", 12), intensity=("<f4", 16)),
        {"intensity": 100.0, "time": SECONDS * 1e6},
        {"unit": "us", "counts_from": "stamp", "scale": 255.0, "first": 0.0},
    ),
}  # fmt: skip


def cloud_of(kind: np.dtype, **changes: Any) -> Any:
    rows = np.zeros(len(POINTS), dtype=kind)
    for i, name in enumerate("xyz"):
        rows[name] = POINTS[:, i]
    options = {name: changes.pop(name) for name in ("height", "width", "row_step", "data") if name in changes}
    for name, values in changes.items():
        rows[name] = np.round(values) if kind[name].kind in "iu" else values
    return MAKE.cloud(STAMP, "top", rows, **options)


def proposed(cloud: Any) -> BagLidar:
    found = cloud_layout(cloud)
    values = {
        "points": "/top", "frame": "top", "revolution_s": 0.1, "motion_compensated": found.compensated,
        "time": yaml.safe_load(found.time), "ring": yaml.safe_load(found.ring),
        "intensity": yaml.safe_load(found.intensity), "intensity_scale": found.scale,
    }  # fmt: skip
    return BagLidar.model_validate(values)


@pytest.mark.parametrize("name", LAYOUTS)
def test_layouts_of_drivers_are_read_by_names_and_offsets(name):
    kind, values, expected = LAYOUTS[name]
    cloud = cloud_of(kind, **values)
    lidar = proposed(cloud)
    assert lidar.time and (lidar.time.unit, lidar.time.counts_from) == (expected["unit"], expected["counts_from"])
    assert lidar.intensity_scale == expected["scale"] and not lidar.motion_compensated
    columns = sweep_columns(cloud, lidar)
    np.testing.assert_allclose(np.stack([columns[axis] for axis in "xyz"], axis=1), POINTS, rtol=1e-6)
    np.testing.assert_allclose(columns["time"], SECONDS + expected["first"], atol=1e-6)
    np.testing.assert_allclose(columns["intensity"], 100 / 255, atol=1e-6)
    assert "ring" not in columns or columns["ring"].tolist() == [0, 1, 2, 3]
    assert ("ring" in columns) == (name != "microseconds")


def test_points_without_a_time_do_not_hide_the_unit():
    """A driver leaves timestamp 0 where nothing returned."""
    kind, values, _ = LAYOUTS["hesai"]
    cloud = cloud_of(kind, **values | {"timestamp": np.array([0, *(STAMP * 1e-6 + SECONDS[1:])])})
    lidar = proposed(cloud)
    assert lidar.time and (lidar.time.unit, lidar.time.counts_from) == ("s", "epoch")
    np.testing.assert_allclose(sweep_columns(cloud, lidar)["time"], SECONDS[1:], atol=1e-6)


def test_big_endian_padded_and_organised_clouds():
    """Two rows of two points, with 8 bytes behind each row; the bytes of numbers in the other order."""
    kind = layout(16, x=(">f4", 0), y=(">f4", 4), z=(">f4", 8), intensity=(">f4", 12))
    rows = np.zeros(4, dtype=kind)
    for i, name in enumerate("xyz"):
        rows[name] = POINTS[:, i]
    padded = b"".join(part.tobytes() + b"\xff" * 8 for part in rows.reshape(2, 2))
    little = layout(16, **XYZ, intensity=("<f4", 12))
    options = {"height": 2, "width": 2, "row_step": 40, "data": np.frombuffer(padded, dtype=np.uint8)}
    cloud = cloud_of(little, **options)
    cloud.is_bigendian = True
    columns = sweep_columns(cloud, BagLidar(points="/t", frame="t", motion_compensated=True))
    np.testing.assert_allclose(np.stack([columns[axis] for axis in "xyz"], axis=1), POINTS, rtol=1e-6)


def test_points_that_are_none_are_left_out():
    cloud = cloud_of(layout(12, **XYZ), x=[np.nan, 0, 3, 0], y=[0, 0, 1, np.inf], z=[1, 0, 1, 1])
    columns = sweep_columns(cloud, BagLidar(points="/t", frame="t", motion_compensated=True))
    assert {name: values.tolist() for name, values in columns.items()} == {"x": [3.0], "y": [1.0], "z": [1.0]}


RING = layout(16, **XYZ, ring=("<f4", 12))
TIMED = layout(16, **XYZ, t=("<u4", 12))
LIDAR = {"points": "/t", "frame": "t", "motion_compensated": True}


@pytest.mark.parametrize(
    ("cloud", "lidar", "words"),
    [
        (cloud_of(layout(12, **XYZ), x=0, y=0, z=0), {}, "has no points"),
        (cloud_of(layout(12, **XYZ), data=np.zeros(40, np.uint8)), {}, "has 40 bytes, too few for 4 points"),
        (cloud_of(layout(12, **XYZ)), {"intensity": "i"}, "has no field i; its fields are x, y, z"),
        (cloud_of(RING, ring=[0, 1, np.nan, 2]), {"ring": "ring"}, "has rings from 0 to 2"),
        (cloud_of(RING, ring=-1), {"ring": "ring"}, "has rings from -1"),
        (
            cloud_of(TIMED, t=[0, 1, 2, 3e9]),
            {"time": PointTime(field="t", unit="ns", counts_from="stamp")},
            "0 to 3 s after its stamp by the field t: check its unit",
        ),
    ],
)
def test_clouds_that_do_not_fit_are_refused(cloud, lidar, words):
    with pytest.raises(DatasetError) as raised:
        sweep_columns(cloud, BagLidar(**LIDAR, **lidar))
    assert words in str(raised.value)


def test_unknown_layout_is_refused():
    kind = np.dtype({"names": ["range", "azimuth"], "formats": ["<f4", "<f4"]})
    with pytest.raises(DatasetError, match="has no field x, y, z; its fields are range, azimuth"):
        cloud_layout(MAKE.cloud(STAMP, "top", np.zeros(3, dtype=kind)))
    cloud = cloud_of(layout(12, **XYZ))
    cloud.point_step = 10
    with pytest.raises(DatasetError, match="do not fit its point_step of 10 bytes"):
        cloud_layout(cloud)


SIZE = (6, 4)
COLORS = np.random.default_rng(1).integers(0, 256, (4, 6, 3), dtype=np.uint8)


def decoded(file: Any) -> np.ndarray:
    with Image.open(BytesIO(file.data)) as image:
        assert image.size == file.size == SIZE
        return np.asarray(image)


def raw(encoding: str, pixels: np.ndarray, padding: int = 0) -> Any:
    rows = pixels.reshape(SIZE[1], -1)
    rows = np.concatenate([rows, np.full((SIZE[1], padding), 7, dtype=np.uint8)], axis=1)
    return MAKE.raw(STAMP, "front", encoding, SIZE, rows)


@pytest.mark.parametrize("padding", [0, 5])
def test_encodings_of_raw_images(padding):
    alpha = np.full((4, 6, 1), 9, dtype=np.uint8)
    for encoding, pixels in (
        ("rgb8", COLORS),
        ("bgr8", COLORS[..., ::-1]),
        ("8UC3", COLORS[..., ::-1]),
        ("rgba8", np.concatenate([COLORS, alpha], axis=2)),
        ("bgra8", np.concatenate([COLORS[..., ::-1], alpha], axis=2)),
    ):
        file = image_file(raw(encoding, pixels, padding), "png")
        np.testing.assert_array_equal(decoded(file), COLORS)
        assert file.suffix == ".png" and not file.grey
    grey = image_file(raw("mono8", COLORS[..., 0], padding), "png")
    np.testing.assert_array_equal(decoded(grey), COLORS[..., 0])
    assert grey.grey and image_file(raw("rgb8", COLORS, padding), "jpeg").suffix == ".jpg"


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_mosaics_become_colours(pattern):
    """A plane of one colour, raw and as a JPEG of the mosaic."""
    color = {"r": 200, "g": 90, "b": 30}
    mosaic = np.array([[color[pattern[2 * (y % 2) + x % 2]] for x in range(6)] for y in range(4)], dtype=np.uint8)
    found = decoded(image_file(raw(f"bayer_{pattern}8", mosaic), "png"))
    assert (found == [200, 90, 30]).all()
    file = BytesIO()
    Image.fromarray(mosaic).save(file, format="PNG")
    form = f"bayer_{pattern}8; png compressed bayer_{pattern}8"
    found = decoded(image_file(MAKE.compressed(STAMP, "front", file.getvalue(), form), "png"))
    assert (found == [200, 90, 30]).all()


def test_yuv_images_become_colours():
    for encoding, order in (("uyvy", [1, 0, 3, 2]), ("yuv422", [1, 0, 3, 2]), ("yuyv", [0, 1, 2, 3])):
        pixels = np.tile(np.array([150, 128, 150, 128], dtype=np.uint8)[order], (4, 3))
        found = decoded(image_file(raw(encoding, pixels), "png")).astype(int)
        assert np.abs(found - found[..., :1]).max() <= 1 and found.min() > 140, encoding


def encoded(form: str, pixels: np.ndarray = COLORS) -> bytes:
    file = BytesIO()
    Image.fromarray(pixels).save(file, format=form)
    return file.getvalue()


def test_files_are_copied_and_other_kinds_encoded():
    for form, suffix in (("JPEG", ".jpg"), ("PNG", ".png")):
        data = encoded(form)
        file = image_file(MAKE.compressed(STAMP, "front", data), "png")
        assert (file.data, file.suffix, file.size, file.grey) == (data, suffix, SIZE, False)
    file = image_file(MAKE.compressed(STAMP, "front", encoded("BMP"), "bmp"), "png")
    np.testing.assert_array_equal(decoded(file), COLORS)
    padded = encoded("JPEG") + b"\0" * 100
    assert image_file(MAKE.compressed(STAMP, "front", padded), "png").data == padded


DEEP = encoded("PNG", np.zeros((4, 6), dtype=np.uint16))


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (raw("mono16", np.zeros((4, 12), np.uint8)), "has the encoding 'mono16'; images have one of rgb8"),
        (MAKE.raw(STAMP, "f", "rgb8", (6, 5), np.zeros((4, 18), np.uint8)), "has 72 bytes, too few for 6x5 pixels"),
        (MAKE.raw(STAMP, "f", "rgb8", (7, 4), np.zeros((4, 18), np.uint8)), "too few for 7x4"),
        (MAKE.raw(STAMP, "f", "rgb8", (0, 4), np.zeros((4, 18), np.uint8)), "is 0x4 pixels"),
        (MAKE.compressed(STAMP, "f", encoded("JPEG")[:-30]), "is a truncated JPEG"),
        (MAKE.compressed(STAMP, "f", encoded("PNG")[:60]), "cannot be decoded"),
        (MAKE.compressed(STAMP, "f", b"junk"), "cannot be decoded"),
        (MAKE.compressed(STAMP, "f", DEEP, "png"), "has more than 8 bits per channel"),
        (MAKE.compressed(STAMP, "f", DEEP, "16UC1; compressedDepth png"), "is an image of depths"),
    ],
)
def test_images_that_cannot_be_used_are_refused(message, words):
    with pytest.raises(DatasetError) as raised:
        image_file(message, "png")
    assert words in str(raised.value)


@pytest.mark.parametrize(
    ("model", "coefficients", "expected"),
    [
        ("plumb_bob", [0.1, 0.2, 0.3, 0.4], ("opencv", 4)),
        ("plumb_bob", [0.1, 0.2, 0.3, 0.4, 0.5], ("opencv", 5)),
        ("plumb_bob", [0.0] * 5, ("none", 0)),
        ("", [], ("none", 0)),
        ("rational_polynomial", [0.1] * 8, ("opencv", 8)),
        ("rational_polynomial", [0.1] * 8 + [0.0] * 6, ("opencv", 14)),
        ("equidistant", [0.1, 0.2, 0.3, 0.4], ("fisheye", 4)),
        ("fisheye", [0.1, 0.2, 0.3, 0.4], ("fisheye", 4)),
    ],
)
def test_models_of_distortion(model, coefficients, expected):
    found, turn = calibration_of(MAKE.info(STAMP, "front", distortion_model=model, d=coefficients), False)
    assert (found.distortion.model, len(found.distortion.coefficients)) == expected
    assert found.distortion.coefficients == tuple(coefficients[: expected[1]])
    assert (found.width, found.height) == (64, 48) and np.array_equal(turn, np.eye(3))


def test_binned_and_cut_images_have_their_own_intrinsics():
    """The centre of a pixel of 2x2 is between the centres of those that it holds."""
    roi = {"x_offset": 10, "y_offset": 6, "width": 40, "height": 30}
    found, _ = calibration_of(MAKE.info(STAMP, "front", binning_x=2, binning_y=2, roi=roi), False)
    assert (found.width, found.height) == (20, 15)
    x = np.array([[12.0, 12.0], [13.0, 13.0]]).mean() - 10  # of the pixels 12 and 13 of the full image
    assert found.K[0][0] == K[0][0] / 2 and (x - 0.5) / 2 == 1.0
    assert (12.5 - K[0][2]) / K[0][0] == pytest.approx((1.0 - found.K[0][2]) / found.K[0][0])


def test_rectified_images_have_the_projection():
    turn = Rotation.from_euler("y", 0.1).as_matrix()
    P = [[40.0, 0, 30, -4], [0, 40, 22, 0], [0, 0, 1, 0]]
    found, rotation = calibration_of(MAKE.info(STAMP, "front", r=turn.ravel(), p=np.ravel(P)), True)
    assert found.K == ((40.0, 0.0, 30.0), (0.0, 40.0, 22.0), (0.0, 0.0, 1.0)) and found.distortion.model == "none"
    np.testing.assert_allclose(rotation, turn)


@pytest.mark.parametrize(
    ("changes", "rectified", "words"),
    [
        ({"k": np.zeros(9)}, False, "has no focal length in K: the camera is not calibrated"),
        ({"p": np.zeros(12)}, True, "has no focal length in P"),
        ({"r": np.zeros(9)}, True, "has an R that is no rotation"),
        ({"k": np.full(9, np.nan)}, False, "not finite"),
        ({"distortion_model": "thin_prism"}, False, "has the distortion model 'thin_prism'"),
        ({"d": [0.1, 0.2, 0.3]}, False, "has 3 coefficients of plumb_bob, which has 4 or 5"),
        ({"width": 0}, False, "says that images are 0x48 pixels"),
    ],
)
def test_calibrations_that_are_none_are_refused(changes, rectified, words):
    with pytest.raises(DatasetError) as raised:
        calibration_of(MAKE.info(STAMP, "front", **changes), rectified)
    assert words in str(raised.value)


def edge(parent: str, child: str, stamps: list[int], angles: list[float], latched: bool = False) -> FrameEdge:
    turns = Rotation.from_euler("z", np.array(angles)[:, None]).as_quat()
    places = np.stack([np.array(angles) * 10, np.zeros(len(angles)), np.zeros(len(angles))], axis=1)
    return FrameEdge(parent, child, np.array(stamps, dtype=np.int64), places, turns, latched)


def pose(angle: float) -> np.ndarray:
    return rigid(Rotation.from_euler("z", angle).as_matrix(), np.array([angle * 10, 0.0, 0.0]))


def test_transforms_are_chained_in_both_directions_and_interpolated():
    tree = TransformTree([edge("map", "odom", [0, 100], [0.0, 0.2]), edge("odom", "base", [0], [0.5], latched=True)])
    found = tree.poses("base", "map", np.array([50]))[0]
    np.testing.assert_allclose(found, pose(0.1) @ pose(0.5), atol=1e-12)
    np.testing.assert_allclose(tree.poses("map", "base", np.array([50]))[0], np.linalg.inv(found), atol=1e-12)
    with pytest.raises(DatasetError, match="tf does not connect base with moon; its frames are base, map, odom"):
        tree.poses("base", "moon", np.array([0]))


def test_path_uses_the_times_at_which_all_transforms_are_known():
    second = 1_000_000
    fast = edge("odom", "base", list(range(0, 10 * second, second // 10)), [0.01 * i for i in range(100)])
    tree = TransformTree([edge("map", "odom", [second, 9 * second], [0.0, 0.1]), fast])
    track = ego_track(tree, "base", "map", np.eye(4))
    assert track.stamps[0] == second and track.stamps[-1] == 9 * second and len(track.stamps) == 81
    still = TransformTree([edge("map", "base", [0], [0.5], latched=True)])
    with pytest.raises(DatasetError, match="holds at all times: there are no poses of the vehicle"):
        ego_track(still, "base", "map", np.eye(4))
    with pytest.raises(DatasetError, match="there are 1 poses of base in map"):
        ego_track(TransformTree([edge("map", "base", [5], [0.5])]), "base", "map", np.eye(4))


def test_motion_continues_for_a_tenth_of_a_second():
    stamps = np.arange(0, 500_001, 50_000)
    track = EgoTrack(stamps, np.stack([pose(stamp * 1e-6) for stamp in stamps]))
    assert [track.covers(stamp) for stamp in (-100_000, -100_001, 600_000, 600_001, 123)] == [True, False] * 2 + [True]
    longer = track.reaching(-80_000, 590_000)
    assert longer.stamps[0] == -80_000 and longer.stamps[-1] == 590_000 and len(longer.stamps) == len(stamps) + 2
    np.testing.assert_allclose(longer.poses[0], pose(-0.08), atol=1e-9)
    np.testing.assert_allclose(longer.poses[-1], pose(0.59), atol=1e-9)
    gap = EgoTrack(np.array([0, 100, 1_000_101]), np.stack([np.eye(4)] * 3))
    assert gap.covers(100) and gap.covers(50) and not gap.covers(101)


def test_transforms_are_sorted_and_the_last_of_a_time_holds():
    table = TransformTable()
    for stamp, angle in ((20, 0.3), (0, 0.1), (20, 0.4)):
        message = MAKE.transforms(stamp, ("/map", "base", pose(angle))).transforms[0]
        table.add(message.header, "base", stamp, message.transform.translation, message.transform.rotation)
    place, bad = MAKE.vector([np.nan, 0, 0]), MAKE.of("geometry_msgs/Quaternion", x=0.0, y=0.0, z=0.0, w=0.0)
    table.add(message.header, "base", 30, message.transform.translation, bad)
    table.add(message.header, "base", 40, place, message.transform.rotation)
    table.add(message.header, "gimbal", 0, message.transform.translation, bad)
    tree = table.tree()
    (only,) = tree.edges
    assert only.parent == "map" and only.stamps.tolist() == [0, 20]
    np.testing.assert_allclose(only.poses(np.array([20]))[0], pose(0.4), atol=1e-12)
    assert tree.damaged == {"transforms of base to map": 2, "transforms of gimbal to map": 1}
