"""masks/: an image of labels and one of sky for every image, from boxes and a heuristic or from the user's own."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from helpers import REPOSITORY
from helpers.drives import CAMERA_AT, CAMERA_TO_EGO, START_US, World, cast
from PIL import Image

from drivesplat.errors import DatasetError, ResultError
from drivesplat.preprocess.masks import NO_SKY, make_masks, sky_mask
from drivesplat.scene.ego_mask import EgoMask
from drivesplat.scene.images import read_image
from drivesplat.scene.masks import UNLABELLED, mask_name, read_classes, read_labels, read_masks_record, read_sky_mask
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.regions import LABELS, fill, hulls_in, label_image, region_mask
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame, Scene, Track, write_scene
from drivesplat.settings.masks import MaskJob

SIZE = (96, 54)


def true_sky(frame: Frame, size: tuple[int, int]) -> np.ndarray:
    """The pixels (h, w) whose rays hit nothing of the tiny drive."""
    focal = 0.62 * size[0]
    x, y = np.meshgrid(np.arange(size[0]) + 0.5 - size[0] / 2, np.arange(size[1]) + 0.5 - size[1] / 2)
    rays = np.stack([x / focal, y / focal, np.ones_like(x)], axis=-1).reshape(-1, 3) @ CAMERA_TO_EGO.T
    seconds = (frame.timestamp - START_US) * 1e-6
    distance, _ = cast(World(), World().ego_at(seconds) + CAMERA_AT, rays, seconds)
    return ~np.isfinite(distance).reshape(size[1], size[0])


def test_labels_and_sky_of_the_tiny_drive_are_stored_with_their_record(tiny_scene, tmp_path):
    frames = tuple(tiny_scene.frames[i] for i in (0, 5, 9, 18))
    scene = dataclasses.replace(tiny_scene, frames=frames)
    record = make_masks(scene, job(), tmp_path)
    shares = []
    for frame in frames:
        at = (tmp_path, "CAM_FRONT", frame.timestamp, SIZE)
        np.testing.assert_array_equal(read_labels(*at), label_image(scene, frame, SIZE))
        found, true = read_sky_mask(*at), true_sky(frame, SIZE)
        shares.append(true.mean())
        assert true.mean() > 0.2 and (found & true).sum() / (found | true).sum() > 0.8
    assert record.sky_share == pytest.approx(np.mean(shares), abs=0.1) and record.own_car == {}
    (tmp_path / "masks.json").write_text(json.dumps(vars(record)))
    assert read_masks_record(tmp_path) == record


def job(width=None, **masks) -> MaskJob:
    return MaskJob.model_validate({"masks": masks, "holdout": {}, "images": {"width": width}})


K = np.array([[0.62 * 96, 0.0, 48.0], [0.0, 0.62 * 96, 27.0], [0.0, 0.0, 1.0]])
"""The tiny drive's camera, continuous convention."""


def test_the_surroundings_of_a_return_and_a_bright_patch_not_connected_to_the_top_are_not_sky(tiny_scene):
    frame = tiny_scene.frames[0]
    pixels = np.full((54, 96, 3), (150, 190, 240), dtype=np.uint8)
    at = frame.camera_to_world @ [0.0, -8.0, 30.0, 1.0]
    without = sky_mask(pixels, K, frame.camera_to_world, None)
    with_it = sky_mask(pixels, K, frame.camera_to_world, at[None, :3])
    row, column = int(27.0 - 0.62 * 96 * 8.0 / 30.0), 48
    assert without[row, column] and not with_it[row, column]
    assert with_it[0, 10] and with_it[0, 85] and 0 < (without & ~with_it).sum() < 60
    patch = np.full((54, 96, 3), (90, 80, 70), dtype=np.uint8)
    patch[8:18, 30:60] = (150, 190, 240)
    assert not sky_mask(patch, K, frame.camera_to_world, None).any()


def test_sky_is_bright_or_blue_and_never_below_the_horizon(tiny_scene):
    """Blue, overcast, and bright haze; night, brick, and concrete."""
    colors = (150, 190, 240), (235, 235, 235), (200, 200, 190), (40, 45, 60), (160, 120, 80), (130, 120, 110)
    for color, is_sky in zip(colors, [True] * 3 + [False] * 3, strict=True):
        pixels = np.full((54, 96, 3), color, dtype=np.uint8)
        mask = sky_mask(pixels, K, tiny_scene.frames[0].camera_to_world, None)
        assert mask.any() == is_sky and mask[:20, 1:-1].all() == is_sky, color
        assert not mask[27:].any()


@pytest.mark.parametrize(
    ("object_class", "is_sky"), [("truck", False), ("trailer", False), ("rider", True), ("construction_vehicle", True)]
)
def test_a_vehicle_as_bright_as_the_sky_is_not_sky(tiny_scene, tmp_path, object_class, is_sky):
    white = tmp_path / "white.png"
    Image.new("RGB", SIZE, (235, 235, 235)).save(white)
    frame = dataclasses.replace(tiny_scene.frames[0], image_path=str(white))
    ahead = np.array([np.eye(4)] * 2)
    ahead[:, :3, 3] = (frame.camera_to_world @ [0.0, -1.0, 14.0, 1.0])[:3]
    box = Track(
        "ahead", ObjectClass(object_class), object_class, np.array([4.0, 3.0, 6.0]),
        frame.timestamp + np.array([0, 500_000]), np.arange(2), ahead, np.full(2, 4),
    )  # fmt: skip
    scene = dataclasses.replace(tiny_scene, frames=(frame,), sweeps=(), tracks=(box,))
    make_masks(scene, job(), tmp_path / "masks")
    sky = read_sky_mask(tmp_path / "masks", "CAM_FRONT", frame.timestamp, SIZE)
    above, (inside,) = sky[:25], (fill(hull.polygon, SIZE)[:25] for hull in hulls_in(scene, frame, SIZE))
    assert inside.sum() > 100 and (~inside).sum() > 100
    assert above[~inside].mean() > 0.9
    assert above[inside].all() if is_sky else not above[inside].any()


def test_the_sky_of_training_images_is_independent_of_held_out_sweeps(tiny_scene, tmp_path):
    """There is one sweep, that of key frame 2, with a return in the middle of every image's sky. It is 465 ms from the
    image of key frame 3, and 285 from the one before its own."""
    frames = [tiny_scene.frames[i] for i in (3, 4, 6)]
    at = np.concatenate([[f.camera_to_world @ [0.0, -8.0, 30.0, 1.0]] for f in frames])
    sweep = tiny_scene.sweeps[2]
    returns = np.zeros((len(frames), 5), dtype=np.float32)
    returns[:, :3] = (at @ inverse(sweep.sensor_to_world).T)[:, :3]
    returns.tofile(tmp_path / "one.pcd.bin")
    only = dataclasses.replace(sweep, path=str(tmp_path / "one.pcd.bin"))
    scene = dataclasses.replace(tiny_scene, frames=tuple(frames), sweeps=(only,))
    row, column = int(27.0 - 0.62 * 96 * 8.0 / 30.0), 48
    for every_nth, open_sky in ((0, [False, False, False]), (8, [True, False, True])):
        holdout = {"every_nth": every_nth, "offset": 2, "last_block": 0}
        make_masks(scene, MaskJob.model_validate({"masks": {}, "holdout": holdout, "images": {}}), tmp_path)
        skies = [read_sky_mask(tmp_path, f.camera, f.timestamp, SIZE) for f in frames]
        assert [sky[row, column] for sky in skies] == open_sky


def users_masks(scene: Scene, folder: Path, of: np.ndarray) -> str:
    """One mask for all images, under the names a user gives: {camera}/{image name}.png."""
    for frame in scene.frames:
        path = folder / frame.camera / f"{Path(frame.image_path).stem}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(of).save(path)
    return str(folder)


@pytest.fixture
def two_images(tiny_scene) -> Scene:
    return dataclasses.replace(tiny_scene, frames=tiny_scene.frames[:2])


SOME_LABELS = np.random.default_rng(0).integers(0, 10, (54, 96)).astype(np.uint8)


def test_masks_of_the_user_are_used(two_images, tmp_path):
    sky = np.where(SOME_LABELS > 4, 255, 0).astype(np.uint8)
    settings = job(
        regions_folder=users_masks(two_images, tmp_path / "mine", SOME_LABELS),
        sky_folder=users_masks(two_images, tmp_path / "sky", sky),
    )
    record = make_masks(two_images, settings, tmp_path / "masks")
    assert (record.regions, record.sky, record.visibility) == ("masks", "masks", None)
    sky[LABELS["own_car"] == SOME_LABELS] = 0
    assert record.sky_share == pytest.approx((sky > 0).mean())
    assert record.own_car == {"CAM_FRONT": "masks"}
    for frame in two_images.frames:
        at = (tmp_path / "masks", "CAM_FRONT", frame.timestamp, SIZE)
        np.testing.assert_array_equal(read_labels(*at), SOME_LABELS)
        np.testing.assert_array_equal(read_sky_mask(*at), sky > 0)


EQUAL = np.stack([SOME_LABELS] * 3, axis=-1)


@pytest.mark.parametrize(
    "pixels",
    [np.kron(SOME_LABELS, np.ones((3, 3), np.uint8)), EQUAL, np.dstack([EQUAL, np.full_like(SOME_LABELS, 7)])],
    ids=["three times as large", "equal channels", "alpha"],
)
def test_masks_of_the_user_are_resized_and_may_have_equal_channels(two_images, tmp_path, pixels):
    settings = job(regions_folder=users_masks(two_images, tmp_path / "mine", pixels))
    make_masks(two_images, settings, tmp_path / "masks")
    made = read_labels(tmp_path / "masks", "CAM_FRONT", two_images.frames[0].timestamp, SIZE)
    np.testing.assert_array_equal(made, SOME_LABELS)


def with_value(value: int, *at: int) -> np.ndarray:
    """A mask but for the value of one pixel."""
    pixels = np.zeros_like(EQUAL if len(at) == 3 else SOME_LABELS)
    pixels[at] = value
    return pixels


@pytest.mark.parametrize(
    ("kinds", "pixels", "words"),
    [
        *(("regions sky semantic", np.zeros(size[::-1], np.uint8), [f"is {size[0]}x{size[1]}", "96x54", "aspect ratio"])
          for size in ((54, 96), (96, 50), (640, 384), (1, 54))),
        ("regions", with_value(1, 3, 4, 2), ["one channel of 8 bits"]),
        ("regions", SOME_LABELS.astype(np.uint16), ["one channel of 8 bits"]),
        ("regions", with_value(10, 3, 4), ["masks.regions_folder", "10"]),
        ("regions", with_value(255, 3, 4), ["masks.regions_folder", "255"]),
        ("regions sky", b"no image", []),
        ("regions sky", None, []),
    ],
)  # fmt: skip
def test_an_invalid_mask_of_the_user_is_named(two_images, tmp_path, kinds, pixels, words):
    """A wrong aspect ratio, colours, unknown labels, a damaged file, none."""
    folder = tmp_path / "mine"
    users_masks(two_images, folder, pixels if isinstance(pixels, np.ndarray) else SOME_LABELS * 0)
    path = folder / "CAM_FRONT" / f"{Path(two_images.frames[0].image_path).stem}.png"
    if pixels is None:
        path.unlink()
    elif isinstance(pixels, bytes):
        path.write_bytes(pixels)
    for kind in kinds.split():
        with pytest.raises(DatasetError) as failure:
            make_masks(two_images, job(**{f"{kind}_folder": str(folder)}), tmp_path / "masks")
        for part in (str(path), *words):
            assert part in str(failure.value)


@pytest.mark.parametrize(
    ("light", "sky", "known"),
    [(1.0, None, True), (0.2, None, False), (1.0, 0, True)],
    ids=["day", "night", "the user's, without sky"],
)
def test_sky_is_unknown_if_none_is_found_unless_the_user_gives_masks(two_images, tmp_path, caplog, light, sky, known):
    dimmed = []
    for frame in two_images.frames:
        path = tmp_path / "images" / Path(frame.image_path).name
        path.parent.mkdir(exist_ok=True)
        Image.fromarray((light * read_image(frame.image_path)).astype(np.uint8)).save(path, quality=95)
        dimmed.append(dataclasses.replace(frame, image_path=str(path)))
    scene = dataclasses.replace(two_images, frames=tuple(dimmed))
    mine = None if sky is None else users_masks(scene, tmp_path / "mine", np.full_like(SOME_LABELS, sky))
    record = make_masks(scene, job(sky_folder=mine), tmp_path / "masks")
    assert record.sky_known is known
    assert [r.getMessage() for r in caplog.records] == ([] if known else [NO_SKY % "0001"])


def test_the_example_of_the_documentation_writes_masks_that_are_accepted(two_images, tmp_path, monkeypatch):
    page = (REPOSITORY / "docs/masks.md").read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    write_scene("results/0061/scene.json", two_images)
    classes = np.arange(54 * 96).reshape(54, 96) % 12
    exec(example, {"segment": lambda image: classes if image.shape == (54, 96, 3) else None})
    record = make_masks(two_images, job(sky_folder="my_sky", semantic_folder="my_classes"), tmp_path / "masks")
    at = (tmp_path / "masks", "CAM_FRONT", two_images.frames[1].timestamp, SIZE)
    np.testing.assert_array_equal(read_sky_mask(*at), classes == 10)
    np.testing.assert_array_equal(read_classes(*at), classes)
    assert record.semantic_classes == 12 and record.sky == "masks"


def test_the_outline_of_the_ego_vehicle_is_excluded_from_every_region(two_images, tmp_path):
    """The lower right quarter of the image, in fractions of its width and height; one pixel of rounding."""
    outline = ((0.5, 0.5), (1.0, 0.5), (1.0, 1.0), (0.5, 1.0))
    ego_mask = EgoMask(
        {"CAM_FRONT": (outline,), "CAM_BACK": (outline,)}, {"CAM_FRONT": "polygons", "CAM_BACK": "images"}
    )
    assert make_masks(two_images, job(), tmp_path, ego_mask).own_car == {"CAM_FRONT": "polygons"}
    for frame in two_images.frames:
        labels = read_labels(tmp_path, "CAM_FRONT", frame.timestamp, SIZE)
        everything, own = region_mask(labels, "all"), labels == LABELS["own_car"]
        assert not everything[28:, 49:].any() and everything[:26].all() and everything[:, :47].all()
        for region in ("static", "vehicle", "moving_vehicle", "parked_vehicle", "moving_human"):
            assert not (region_mask(labels, region) & own).any()
        np.testing.assert_array_equal(labels[~own], label_image(two_images, frame, SIZE)[~own])


def test_the_ego_vehicle_is_neither_sky_nor_of_any_class(two_images, tmp_path):
    """The user's masks say that all is sky, and of class 3."""
    settings = job(
        sky_folder=users_masks(two_images, tmp_path / "full", np.full_like(SOME_LABELS, 255)),
        semantic_folder=users_masks(two_images, tmp_path / "classes", np.full_like(SOME_LABELS, 3)),
    )
    lower_half = ((0.0, 0.5), (1.0, 0.5), (1.0, 1.0), (0.0, 1.0))
    ego_mask = EgoMask({"CAM_FRONT": (lower_half,)}, {"CAM_FRONT": "polygons"})
    record = make_masks(two_images, settings, tmp_path / "masks", ego_mask)
    assert (record.semantic_classes, record.sky_share) == (4, 0.5)
    at = (tmp_path / "masks", "CAM_FRONT", two_images.frames[0].timestamp, SIZE)
    sky, found = read_sky_mask(*at), read_classes(*at)
    assert sky[:27].all() and not sky[27:].any()
    assert (found[:27] == 3).all() and (found[27:] == UNLABELLED).all()


@pytest.mark.parametrize(("kind", "read"), [("sky", read_sky_mask), ("regions", read_labels)])
def test_an_invalid_mask_is_named_with_its_rule(two_images, tmp_path, kind, read):
    """Those made without LiDAR."""
    assert make_masks(dataclasses.replace(two_images, sweeps=()), job(), tmp_path).images == 2
    first, timestamp = (frame.timestamp for frame in two_images.frames)
    path = tmp_path / mask_name(kind, "CAM_FRONT", timestamp)
    for content in (path.read_bytes()[:50], b"no image", None):
        path.unlink() if content is None else path.write_bytes(content)
        with pytest.raises(ResultError, match=rf"{timestamp}\.png.*'masks'"):
            read(tmp_path, "CAM_FRONT", timestamp, SIZE)
    assert read(tmp_path, "CAM_FRONT", first, SIZE).shape == (54, 96)


def test_a_missing_image_is_named(two_images, tmp_path):
    absent = dataclasses.replace(two_images.frames[1], image_path=str(tmp_path / "absent.jpg"))
    scene = dataclasses.replace(two_images, frames=(two_images.frames[0], absent))
    with pytest.raises(DatasetError, match=absent.image_path):
        make_masks(scene, job(), tmp_path / "masks")
