"""People in the images on which models are measured: enough of them, within boxes that fit."""

import numpy as np
import pytest
from helpers.demo_worlds import FRONT, annotated, names_of, recorder_of

from drivesplat.scene.regions import MIN_PIXELS, fill, hulls_in, label_image, region_mask
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import held_out_key_frames
from drivesplat.settings.images import HoldoutSettings
from drivesplat.world.recorder import Recorder

pytestmark = pytest.mark.slow

WIDTH = 400
"""The width of the default world."""
SIZE = (WIDTH, WIDTH * 9 // 16)
MIN_REGION = 5000
"""Pixels of moving people in the held-out images of a group, for a figure that one person does not decide."""
GROUPS = held_out_key_frames(20, HoldoutSettings())
HELD_OUT = sorted(GROUPS["interpolation"] + GROUPS["extrapolation"])


@pytest.fixture(scope="module")
def default() -> Recorder:
    return recorder_of(width=WIDTH)


@pytest.fixture(scope="module")
def riders() -> Recorder:
    return recorder_of(width=WIDTH, cyclists=4, bystanders=6, random_seed=1)


def scene_and_objects(recorder: Recorder) -> tuple[Scene, dict[int, np.ndarray]]:
    """The annotated drive and, by held-out key frame, the object (h, w) that each pixel shows."""
    scene = annotated(recorder, HELD_OUT)
    return scene, {f.sample_index: recorder.geometry(FRONT, f.timestamp).objects for f in scene.frames}


@pytest.fixture(scope="module")
def of_default(default) -> tuple[Scene, dict[int, np.ndarray]]:
    return scene_and_objects(default)


@pytest.fixture(scope="module")
def of_riders(riders) -> tuple[Scene, dict[int, np.ndarray]]:
    return scene_and_objects(riders)


def test_the_default_world_is_the_one_measured(default):
    assert default.world.pedestrians == 10 and default.world.key_frames == 20


@pytest.mark.parametrize("group", GROUPS)
def test_held_out_images_of_each_group_show_enough_moving_people(of_default, group):
    scene, _ = of_default
    pixels = {
        frame.sample_index: int(region_mask(label_image(scene, frame, SIZE), "moving_human").sum())
        for frame in scene.frames
        if frame.sample_index in GROUPS[group]
    }
    print(f"{group}: {pixels}, together {sum(pixels.values())}")
    assert sum(pixels.values()) >= MIN_REGION
    assert sum(count > 0 for count in pixels.values()) >= len(GROUPS[group]) / 2


def overlaps(
    recorder: Recorder, scene: Scene, objects: dict[int, np.ndarray], kind: str
) -> list[tuple[str, int, float]]:
    """Name, key frame and intersection over union of hull and pixels, of everybody of a kind who is in clear view."""
    names, found = names_of(recorder), []
    for frame in scene.frames:
        for hull in hulls_in(scene, frame, SIZE):
            own = objects[frame.sample_index] == names.index(hull.box.track_id)
            clear = hull.box.visibility == 4 and own.sum() >= MIN_PIXELS
            if hull.box.track_id.startswith(kind) and clear:
                within = fill(hull.polygon, SIZE)
                iou = float((within & own).sum() / (within | own).sum())
                found.append((hull.box.track_id, frame.sample_index, iou))
    return found


@pytest.mark.parametrize("kind", ["pedestrian", "bystander", "cyclist"])
def test_hulls_fit_people_and_riders(riders, of_riders, kind):
    found = overlaps(riders, *of_riders, kind)
    ious = [iou for *_, iou in found]
    print(f"{kind}: {len(found)} in view, median {np.median(ious):.3f}, least {min(ious):.3f}")
    assert len(found) >= 3 and np.median(ious) > 0.5


@pytest.mark.parametrize(("walkways", "low", "high"), [(["sidewalk"], 6.65, 10.0), (["road"], 2.7, 6.4)])
def test_pedestrians_walk_where_they_are_asked_to(walkways, low, high):
    recorder = recorder_of(pedestrians=9, walkways=walkways)
    walkers = [item for item in recorder.objects if item.name.startswith("pedestrian")]
    assert len(walkers) == 9
    for item in walkers:
        aside = np.abs(item.poses(np.linspace(0.0, 9.5, 20))[:, 1, 3])
        assert (aside > low).all() and (aside < high).all(), item.name
