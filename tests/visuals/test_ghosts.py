"""What a moving box sweeps, and which Gaussians are its ghosts: against closed forms and dense sampling in time."""

import numpy as np
import pytest
import torch
from helpers.classed import classed
from helpers.hand_made import Own, recording_of, round_gaussians
from scipy.spatial.transform import Rotation

from drivesplat.model.part import Part
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.scene import Scene, Track
from drivesplat.scene.tracks import box_at
from drivesplat.settings.visuals import GhostSettings
from drivesplat.visuals.ghosts import ghost_figures, ghosts_of, in_swept_volume
from drivesplat.visuals.rendered_view import ModelWithRecording, RenderedView

START = 1_532_402_927_647_951
INTERVAL = 500_000.0
"""Microseconds between key frames."""
SIZE = np.array([4.0, 2.0, 1.6])
SLACK = 0.26
"""Metres: a box is looked at every 0.25 m of its way, so that much of its ends may be missed."""


def pose(x: float, y: float, z: float = 0.0, angle: float = 0.0) -> np.ndarray:
    """In closed form: turned about z, then moved."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]])


def track_of(poses: list[np.ndarray], seconds=None, indices=None, size=SIZE) -> Track:
    indices = np.arange(len(poses)) if indices is None else np.array(indices)
    seconds = 0.5 * indices if seconds is None else np.array(seconds)
    times = START + np.round(seconds * 1e6).astype(np.int64)
    visibility = np.full(len(poses), 4)
    return Track(
        "it", *classed("vehicle.car"), np.array(size, dtype=float), times, indices, np.stack(poses), visibility
    )


def straight(speed: float, count: int = 7, heading: float = 0.0, **changes) -> Track:
    """From the origin on along `heading`, `speed` metres a second."""
    step_m = np.array([np.cos(heading), np.sin(heading)]) * speed
    return track_of([pose(*(0.5 * i * step_m), angle=heading) for i in range(count)], **changes)


def around(place: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 3) of the box's frame in the world."""
    return points @ place[:3, :3].T + place[:3, 3]


@pytest.mark.parametrize(("speed", "heading"), [(0.0, 1.1), (1.5, -2.5), (10.0, 0.0), (60.0, 1.1)])
def test_a_straight_path_sweeps_a_long_box(speed, heading):
    """From half a key-frame interval before the first box to as long after the last: length + 3.5 s of way."""
    it = straight(speed, heading=heading)
    random = np.random.default_rng(0)
    low, high = np.array([-0.25 * speed - 5.0, -2.5, -2.0]), np.array([3.25 * speed + 5.0, 2.5, 2.0])
    along = random.uniform(low, high, (20_000, 3))
    found = in_swept_volume(it, INTERVAL, around(pose(0, 0, angle=heading), along))
    beyond = np.maximum(-0.25 * speed - 2.0 - along[:, 0], along[:, 0] - 3.25 * speed - 2.0)
    beside = np.maximum(np.abs(along[:, 1]) - 1.0, np.abs(along[:, 2]) - 0.8)
    assert not found[(beyond > 1e-6) | (beside > 1e-6)].any()
    certain = (beyond < -SLACK) & (beside < -1e-6)
    assert certain.sum() > 1000 and found[certain].all()


@pytest.mark.parametrize(
    ("speed", "turn", "size"), [(3.0, -0.8, (12.0, 2.6, 3.4)), (12.0, 0.4, SIZE), (30.0, 0.0, (0.6, 0.5, 1.7))]
)
def test_the_swept_volume_is_complete_between_annotations(speed, turn, size):
    """Points moving with the box, within its faces, at every 4 ms; `turn` in radians a key frame.

    Half a step of the way and half a step of turning may be missed at the faces.
    """
    places = [np.zeros(2)]
    for i in range(5):
        places.append(places[-1] + 0.5 * speed * np.array([np.cos(turn * i), np.sin(turn * i)]))
    it = track_of([pose(*place, angle=turn * i) for i, place in enumerate(places)], size=size)
    swing = min(0.125, 0.125 / speed) * abs(turn) / 0.5 * np.linalg.norm(size) / 2
    shrunk = min(0.13 + swing, 0.24)
    axes = [np.linspace(-s / 2 + shrunk, s / 2 - shrunk, 7) for s in size]
    inner, points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3), []
    for step, seconds in enumerate(np.arange(0.0, 2.5, 0.004)):
        i = min(int(seconds / 0.5), 4)
        share = seconds / 0.5 - i
        x, y = (1.0 - share) * places[i] + share * places[i + 1]
        points.append(around(pose(x, y, angle=turn * (i + share)), inner[step % 7 :: 7]))
    assert in_swept_volume(it, INTERVAL, np.concatenate(points)).all()


def test_a_turning_box_sweeps_nothing_beside_its_path(turn=-0.8):
    """Random points against boxes every 10 ms, posed by the protocol's interpolation."""
    it = track_of([pose(8.0 * np.cos(turn * i), 8.0 * np.sin(turn * i), 0.0, turn * i) for i in range(6)])
    points = np.random.default_rng(1).uniform([-14, -14, -2], [14, 14, 2], (20_000, 3))
    certain = np.zeros(len(points), dtype=bool)
    possible = certain.copy()
    for time in range(START - 250_000, START + 2_750_001, 10_000):
        place = box_at(it, time, INTERVAL).object_to_world
        in_box = np.abs((points - place[:3, 3]) @ place[:3, :3]) - SIZE / 2
        possible |= (in_box < 0.05).all(axis=1)
        certain |= (in_box < -0.25).all(axis=1)
    found = in_swept_volume(it, INTERVAL, points)
    assert certain.sum() > 300 and found[certain].all()
    assert not found[~possible].any() and not found.all()


def test_clearance_is_above_the_floor_of_the_box_on_a_slope():
    """Uphill by a fifth, the boxes tilted with the road."""
    tilt = np.arctan(0.2)
    slope = np.eye(4)
    slope[:3, :3] = Rotation.from_euler("y", -tilt).as_matrix()
    poses = []
    for i in range(5):
        place = slope.copy()
        place[:3, 3] = slope[:3, 0] * 4.0 * i
        poses.append(place)
    above = np.array([[9.0, 0.3, 0.3 - 0.8], [9.0, 0.3, 0.1 - 0.8], [9.0, 0.3, 0.79], [9.0, 0.3, 0.81]])
    found = in_swept_volume(track_of(poses), INTERVAL, around(slope, above), floor=0.2)
    np.testing.assert_array_equal(found, [True, False, True, False])


@pytest.mark.parametrize("speed", [2.0, 30.0])
def test_nothing_is_swept_in_a_gap_of_the_annotation(speed):
    """Key frames 3 to 6 do not hold it; it reaches a quarter of a second into the gap at both ends."""
    indices = [0, 1, 2, 7, 8, 9]
    it = track_of([pose(0.5 * i * speed, 0.0) for i in indices], indices=indices)
    x = np.arange(-20.0, 5.0 * speed + 20.0, 0.05)
    found = in_swept_volume(it, INTERVAL, np.outer(x, [1.0, 0.0, 0.0]))
    margins = [
        np.maximum((first - 0.25) * speed - 2.0 - x, x - (last + 0.25) * speed - 2.0)
        for first, last in ((0.0, 1.0), (3.5, 4.5))
    ]
    nearest = np.minimum(*margins)
    assert not found[nearest > 1e-6].any()
    assert found[nearest < -SLACK].all()
    assert in_swept_volume(it, INTERVAL, np.zeros((0, 3))).shape == (0,)


@pytest.fixture(scope="module")
def scene(one_car) -> Scene:
    """One car at 10 m/s along y = 0.5, its centre 0.8 m over the road, its first box at x = 5."""
    return one_car(10.0, 5.0, 0.5)


LATER = 8
"""The image of key frame 4, at x = 5 + 10 (2.0 - 0.035) = 24.65."""


PLACES = np.array(
    [
        [10.0, 0.5, 0.8],  # where it was
        [40.0, 0.5, 0.8],  # where it will be
        [24.7, 0.5, 0.8],  # in the box now
        [24.7, 0.5, 0.1],  # in the box now, lower than the clearance
        [10.0, 0.5, 0.1],  # road where it was
        [10.0, 2.0, 0.8],  # beside its way
        [10.0, 0.5, 1.7],  # above its way
        [26.6, 1.4, 1.5],  # in the box's corner
        [26.8, 1.4, 1.5],  # right before it
    ]
)
GHOSTS = np.array([True, True, False, False, False, False, False, False, True])


def render_image(scene: Scene, *parts: Part, index: int = LATER) -> RenderedView:
    model = SplatModel(parts, None).requires_grad_(False)
    return RenderedView(ModelWithRecording(model, recording_of(scene), torch.device("cpu")), index)


LATER = 8
"""The image of key frame 4, at x = 5 + 10 (2.0 - 0.035) = 24.65."""


def ghosts_at(rendered: RenderedView, clearance: float = 0.2) -> torch.Tensor:
    scene = rendered.drive.recording.scene
    box = box_at(scene.tracks[0], rendered.frame.timestamp, scene.key_frame_interval)
    return ghosts_of(rendered, box, GhostSettings(clearance=clearance))


def test_ghosts_lie_on_the_path_but_not_in_the_present_box(scene):
    """Without a clearance the road counts as ghosts."""
    rendered = render_image(scene, round_gaussians(PLACES))
    np.testing.assert_array_equal(ghosts_at(rendered), GHOSTS)
    without = ghosts_at(rendered, clearance=0.0)
    np.testing.assert_array_equal(np.flatnonzero(without & ~torch.from_numpy(GHOSTS)), [4])
    earlier = ghosts_at(render_image(scene, round_gaussians(PLACES[:4]), index=1))
    np.testing.assert_array_equal(earlier, [True, True, True, False])


@pytest.mark.parametrize(("whose", "moves"), [("it", True), ("another", True), ("it", False)])
def test_gaussians_of_parts_that_move_are_no_ghosts(scene, whose, moves, monkeypatch):
    """Two parts of the same Gaussians: those that go where their object goes are no ghosts wherever they lie. That the
    object is known does not make it go: the part has to move."""
    monkeypatch.setattr(Own, "moves", moves)
    found = ghosts_at(render_image(scene, round_gaussians(PLACES), Own(round_gaussians(PLACES), whose)))
    np.testing.assert_array_equal(found, [*GHOSTS, *(GHOSTS & (not moves))])


def test_figures_of_ghosts(scene):
    """The median of two is their mean."""
    opacities = [0.1, 0.4, 0.9, 0.9, 0.9, 0.9, 0.9, 0.9, 0.7]
    rendered = render_image(scene, round_gaussians(PLACES, opacities=opacities))
    figures = ghost_figures(rendered.gaussians, ghosts_at(rendered))
    expected = {"gaussians": 3, "opacity_sum": 1.2, "opacity_mean": 0.4, "opacity_median": 0.4}
    assert {name: figures[name] for name in expected} == pytest.approx(expected, abs=1e-6)
    rendered = render_image(scene, round_gaussians(PLACES[:2], opacities=[0.2, 0.6]))
    median = ghost_figures(rendered.gaussians, ghosts_at(rendered))["opacity_median"]
    assert median == pytest.approx(0.4, abs=1e-6)
