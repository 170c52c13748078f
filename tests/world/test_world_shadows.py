"""Views of an altered street differ from the recorded one in the altered objects' pixels and shadows, nowhere else."""

import numpy as np
import pytest
from helpers.demo_worlds import FRONT, edit_of, meshes_at, named, names_of, recorder_of
from scipy.ndimage import binary_dilation

from drivesplat.world.optics.imaging import WorldCamera
from drivesplat.world.optics.raycast import NO_HIT
from drivesplat.world.recorder import RECORDED, Recorder, Viewpoint

WIDTH, HEIGHT, TIME_US = 160, 90, 1_964_500
OTHER = "placed"
ALTERED = {
    "without the leading vehicle": (Viewpoint(without="vehicle 0"), "vehicle 0", None),
    "with a placed vehicle": (Viewpoint(edit="placed"), OTHER, "placed"),
    "with a removed vehicle": (Viewpoint(edit="removed"), "vehicle 0", None),
}
"""The viewpoint, the object that only one of the two streets has, and the edit after which it is there."""


@pytest.fixture(scope="module")
def recorder() -> Recorder:
    plain = recorder_of(width=WIDTH)
    ahead = plain.instance("vehicle 0")
    edits = {
        "placed": edit_of({"place": {"track": ahead, "as": OTHER, "path": [[0.0, 34.0, 3.5], [9.0, 16.0, 3.5]]}}),
        "removed": edit_of({"remove": {"track": ahead[:8]}}),
    }
    return recorder_of(edits, width=WIDTH)


def points_of(depth: np.ndarray, camera: WorldCamera) -> np.ndarray:
    """The street coordinates (n, 3) of what each pixel's centre shows."""
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(camera.intrinsics).T
    in_camera = rays * np.where(np.isfinite(depth), depth, 0.0)[..., None]
    return (in_camera @ camera.pose[:3, :3].T + camera.pose[:3, 3]).reshape(-1, 3)


def shaded_by(triangles: np.ndarray, points: np.ndarray, sun: np.ndarray, margin: float = 0.05) -> np.ndarray:
    """Which points (n, 3) have the box around `triangles` (f, 3, 3), a little larger, between them and the sun."""
    corners = triangles.reshape(-1, 3)
    low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    with np.errstate(divide="ignore"):
        a, b = (low - points) / sun, (high - points) / sun
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return (enter < leave) & (leave > 0)


@pytest.fixture(scope="module", params=ALTERED)
def altered(request, recorder):
    """The images with and without the object, its pixels, and those it may shade."""
    view, name, edit = ALTERED[request.param]
    pictures = [recorder.picture(FRONT, TIME_US, v) for v in (RECORDED, view)]
    pictures = pictures if edit is None else pictures[::-1]
    with_it, without = (recorder.to_bytes(picture.radiance, FRONT, TIME_US) for picture in pictures)
    own = pictures[0].objects == names_of(recorder, edit).index(name)
    camera = recorder.camera(FRONT, TIME_US * 1e-6)
    item = named(recorder, name, edit)
    points = points_of(pictures[0].depth, camera)
    sun = recorder.light(TIME_US * 1e-6).sun_direction
    shaded = shaded_by(meshes_at(item, TIME_US * 1e-6), points, sun).reshape(own.shape)
    return with_it, without, own, shaded & (pictures[0].objects != NO_HIT) & ~own


def test_only_its_pixels_and_its_shadow_change(altered):
    with_it, without, own, shaded = altered
    changed = (with_it != without).any(axis=2)
    assert changed.any() and own.any()
    assert not (changed & ~own & ~shaded).any()


def test_its_pixels_change(altered):
    with_it, without, own, _ = altered
    assert own.sum() > 60
    assert (with_it != without).any(axis=2)[own].mean() > 0.9


def test_its_shadow_on_the_road_is_gone_without_it(altered):
    with_it, without, own, _ = altered
    change = without.astype(int) - with_it
    beside = (change != 0).any(axis=2) & ~own
    assert beside.sum() >= 5
    assert (change[beside] >= 0).all() and change[beside].mean() > 10
    rows, columns = np.nonzero(own)
    at = np.argwhere(beside)
    assert (at[:, 0] > rows.mean()).all(), "it lies on the road, below the car's middle"
    assert (np.abs(at[:, 1] - columns.mean()) < 2 * np.ptp(columns)).all()


def test_it_leaves_no_trace_on_the_road_below_it(altered):
    """What the car hid is road in the sun: as light as the road beside it."""
    _, without, own, _ = altered
    lower = own & (np.arange(HEIGHT)[:, None] > np.nonzero(own)[0].mean())
    around = binary_dilation(lower, iterations=6) & ~binary_dilation(own, iterations=2)
    assert without[lower].mean() > 0.6 * without[around].mean()
