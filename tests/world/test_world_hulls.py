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


def vehicles(scene, recorder, frame, objects):
    """Per vehicle in clear view: the vehicle, its hull's pixels, its own pixels."""
    tokens = {instance_token("demo", item.name): n for n, item in enumerate(recorder.objects)}
    for hull in hulls_in(scene, frame, SIZE):
        own = objects == tokens[hull.box.track_id]
        if hull.box.category.startswith("vehicle.") and hull.box.visibility == 4 and own.sum() >= MIN_PIXELS:
            yield recorder.objects[tokens[hull.box.track_id]], fill(hull.polygon, SIZE), own


def test_vehicles_lie_within_their_hulls_at_the_image_time(scene, recorder, seen):
    frame, objects = seen
    for item, hull, own in vehicles(scene, recorder, frame, objects):
        assert not (own & ~binary_dilation(hull, np.ones((3, 3)))).any(), f"{item.name} sticks out of its hull"


def test_the_label_image_separates_moving_and_parked_vehicles(scene, recorder, seen):
    frame, objects = seen
    labels = label_image(scene, frame, SIZE)
    names = np.array([item.name for item in recorder.objects])
    for item, _, own in vehicles(scene, recorder, frame, objects):
        kind = "parked" if item.name.startswith("parked") else "moving"
        expected = [LABELS[f"{kind}_car"], LABELS[f"{kind}_other_vehicle"]]
        assert np.isin(labels[own], expected).mean() > 0.8, item.name
    walker = objects == list(names).index("pedestrian 0")
    if walker.sum() >= MIN_PIXELS:
        assert (labels[walker] == LABELS["moving_human"]).mean() > 0.8
