"""The film of LiDAR scans: its frames, captions and record."""

import dataclasses
from typing import get_args

import numpy as np
import pytest
from helpers.scan_drives import KEY_FRAME_US, STEPS, recorded, room
from matplotlib.colors import to_rgb

from drivesplat.io.video import read_footage
from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.splits import SIDE_CAMERA, Group
from drivesplat.settings.render import LidarFilmJob
from drivesplat.visuals import lidar_film
from drivesplat.visuals.lidar_film import NOTES, render_lidar_film
from drivesplat.visuals.lidar_frame import (
    HEIGHT_COLORS,
    ONLY_RECORDED,
    ONLY_RENDERED,
    RECORDED,
    RENDERED,
    SIZE,
    VIEW_SIZE,
    VIEWS,
    LidarFrames,
)
from drivesplat.visuals.scan_picture import ERROR_COLORS, ERRORS, RANGE_COLORS, RANGES, UNMEASURED

LEVEL, AHEAD, LEFT = 2, STEPS // 2, STEPS // 2 + STEPS // 4
"""The level beam, and the firings along the sensor's x and y axes."""
JOB = LidarFilmJob(crf=30, captions=True)


def alone(*places: tuple[int, int], radius: float = 12.0) -> np.ndarray:
    """Ranges of which only those at these beams and firings return."""
    ranges = np.full(room().shape, np.nan)
    for place in places:
        ranges[place] = radius
    return ranges


def rendered(ranges: np.ndarray) -> RenderedScan:
    return RenderedScan(np.nan_to_num(ranges), np.isnan(ranges).astype(float))


def bytes_of(color) -> np.ndarray:
    return np.round(255 * np.array(to_rgb(color)[:3]))


def shown(view: np.ndarray, color) -> np.ndarray:
    """The centre (row, column) of what has a colour in a view."""
    found = np.argwhere((np.abs(view.astype(int) - bytes_of(color)) <= 1).all(axis=-1))
    assert len(found), "nothing has this colour"
    return found.mean(axis=0)


def frame_of(scan, found) -> np.ndarray:
    return LidarFrames([recorded(room())], 0.0, "a film").frame(scan, found)


def test_errors_misses_and_false_returns_have_their_colours():
    scan = recorded(alone((LEVEL, AHEAD), (LEVEL, LEFT)))
    found = rendered(alone((LEVEL, AHEAD), (LEVEL, 0), radius=13.0))
    view = VIEWS[2].inside(frame_of(scan, found))
    off_by_a_metre = ERROR_COLORS(ERRORS(1.0))
    colors = {off_by_a_metre: (-13.0, 0.0), ONLY_RECORDED: (0.0, -12.0), ONLY_RENDERED: (13.0, 0.0)}
    for color, place in colors.items():
        near = VIEW_SIZE / 2 + VIEW_SIZE / 40.0 * np.array(place)
        rows, columns = (slice(int(at) - 6, int(at) + 7) for at in near)
        np.testing.assert_allclose(shown(view[rows, columns], color), [6.0, 6.0], atol=1.5)


def test_range_images_show_what_returned_and_which_rays_say_nothing():
    ranges, measured = room(20.0), np.ones(room().shape, dtype=bool)
    ranges[:, :10], measured[:, 30:40] = np.nan, False
    frame = frame_of(recorded(ranges, measured=measured), rendered(room(30.0)))
    assert frame.shape == (SIZE[1], SIZE[0], 3) and frame.dtype == np.uint8
    top, bottom = RECORDED.inside(frame), RENDERED.inside(frame)

    def column(firing: int) -> int:
        """Firings turn to the left; the first looks behind, at the left rim."""
        return int(((STEPS - firing) % STEPS + 0.5) / STEPS * RECORDED.width)

    np.testing.assert_allclose(top[5, column(AHEAD)], bytes_of(RANGE_COLORS(RANGES(20.0))), atol=1)
    np.testing.assert_allclose(bottom[5, column(AHEAD)], bytes_of(RANGE_COLORS(RANGES(30.0))), atol=1)
    assert (top[:, column(5)] == 0).all() and (bottom[:, column(5)] != 0).any()
    for image in (top, bottom):
        np.testing.assert_array_equal(image[5, column(35)], bytes_of(UNMEASURED))


@pytest.mark.parametrize(("ahead", "row", "column"), [(0.0, -1, 0), (np.pi / 2, 0, 1), (np.pi, 1, 0)])
def test_a_return_is_at_its_place_from_above(ahead, row, column):
    """12 m along the x axis: ahead, to the right of a sensor that travels along y, or behind."""
    frames = LidarFrames([recorded(room())], ahead, "")
    assert frames.reach == 20.0
    frame = frames.frame(recorded(alone((LEVEL, AHEAD))), rendered(alone((LEVEL, AHEAD), radius=6.0)))
    color = HEIGHT_COLORS(frames.heights(0.0))
    pixels = VIEW_SIZE / 40.0
    for view, metres in ((VIEWS[0], 12.0), (VIEWS[1], 6.0)):
        expected = VIEW_SIZE / 2 + metres * pixels * np.array([row, column])
        np.testing.assert_allclose(shown(view.inside(frame), color), expected, atol=1.5)


def test_all_frames_have_the_scales_of_the_drive():
    scans = [recorded(room(radius)) for radius in (12.0, 55.0)]
    frames = LidarFrames(scans, None, "")
    assert frames.reach == 60.0 and frames.heights.vmin == np.floor(-55.0 * np.sin(np.radians(20.0)))
    below = LidarFrames([recorded(alone((0, AHEAD), (1, AHEAD)))], None, "")
    assert (below.heights.vmin, below.heights.vmax) == (-5.0, 0.0)
    assert LidarFrames([recorded(room(300.0))], None, "").reach == 100.0
    assert LidarFrames([recorded(alone())], None, "").reach == 20.0, "also where nothing returns"


def drive() -> list:
    groups = ("train", "interpolation", "excluded", "extrapolation")
    return [recorded(room(), timestamp=i * KEY_FRAME_US, group=group) for i, group in enumerate(groups)]


def test_the_film_has_a_frame_of_each_scan_and_their_figures(lidar_of, tmp_path):
    path = tmp_path / "lidar.mp4"
    record = render_lidar_film(lidar_of(drive()), "mine", JOB, path)
    footage = read_footage(path)
    assert (footage.frames, footage.width, footage.height, footage.fps) == (4, *SIZE, 2.0)
    assert (record["lidar"], record["fps"], record["frames"], record["reach_m"]) == ("top", 2, 4, 20.0)
    assert [scan["split"] for scan in record["scans"]] == [scan.group for scan in drive()]
    assert [scan["second"] for scan in record["scans"]] == [0.0, 0.5, 1.0, 1.5]
    assert all(scan["range_error_median_m"] == pytest.approx(0.1, abs=1e-4) for scan in record["scans"])
    assert "chamfer_m" not in record["scans"][0] and record["bytes"] == path.stat().st_size


def test_captions_say_which_scans_are_held_out(lidar_of, tmp_path, monkeypatch):
    captions = []
    monkeypatch.setattr(lidar_film, "encode_film", lambda _, frames, *__: captions.extend(c for _, c in frames) or {})
    scans = drive()
    scans[1] = dataclasses.replace(scans[1], scan=recorded(alone()).scan)
    render_lidar_film(lidar_of(scans), "mine", JOB, tmp_path / "lidar.mp4")
    assert [caption.notes for caption in captions] == [
        ["training scan"], ["held out between training frames"], ["neither trained on nor measured"],
        ["held out beyond the last training frame"],
    ]  # fmt: skip
    assert {*NOTES, SIDE_CAMERA} == set(get_args(Group))
    assert captions[0].labels[0].startswith("range off by 10.0 cm (median)") and captions[3].clock == "1.5 s"
    assert captions[1].labels == ["0.0 % of returns and drops right"], "nothing was recorded there"
