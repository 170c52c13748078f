"""Box hulls, which the measuring protocol takes for an object's pixels, against the pixels it truly covers."""

import numpy as np
import pytest
from helpers import drives
from helpers.demo_worlds import FRONT
from scipy.ndimage import binary_dilation

from drivesplat.scene.regions import LABELS, MIN_PIXELS, fill, hulls_in, label_image
from drivesplat.world.recorder import Recorder
from drivesplat.world.tokens import instance_token

pytestmark = pytest.mark.slow

SIZE = (400, 225)
"""The demo's own size."""


@pytest.fixture(scope="module")
def scene(demo_root):
    return drives.scene_at(demo_root, dataset="demo", scene="demo")


@pytest.fixture(scope="module")
def recorder(demo_job) -> Recorder:
    return Recorder(demo_job.world.model_copy(update={"width": SIZE[0]}))


@pytest.fixture(scope="module", params=[0, 8, 15, 23, 30])
def seen(request, scene, recorder):
    """An image (also one between key frames) and the object (h, w) that each pixel shows."""
    frame = scene.frames[request.param]
    return frame, recorder.geometry(FRONT, int(frame.timestamp - scene.key_frame_timestamps[0])).objects


def test_vehicles_lie_within_their_hulls_and_have_the_label_of_moving_or_parked_ones(scene, recorder, seen):
    """Vehicles in clear view, and a walker."""
    frame, objects = seen
    labels, names = label_image(scene, frame, SIZE), [item.name for item in recorder.objects]
    numbers = {instance_token("demo", name): n for n, name in enumerate(names)}
    for hull in hulls_in(scene, frame, SIZE):
        number = numbers[hull.box.track_id]
        own = objects == number
        if not hull.box.category.startswith("vehicle.") or hull.box.visibility != 4 or own.sum() < MIN_PIXELS:
            continue
        around = binary_dilation(fill(hull.polygon, SIZE), np.ones((3, 3)))
        assert not (own & ~around).any(), f"{names[number]} sticks out of its hull"
        kind = "parked" if names[number].startswith("parked") else "moving"
        expected = [LABELS[f"{kind}_car"], LABELS[f"{kind}_other_vehicle"]]
        assert np.isin(labels[own], expected).mean() > 0.8, names[number]
    walker = objects == names.index("pedestrian 0")
    if walker.sum() >= MIN_PIXELS:
        assert (labels[walker] == LABELS["moving_human"]).mean() > 0.8
