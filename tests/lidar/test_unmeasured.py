"""Rays that say nothing: those of the ego vehicle, and those of skipped sectors."""

import numpy as np
import pytest
from helpers.scan_drives import BEAMS, STEPS, recorded, room

from drivesplat.lidar.unmeasured import blocked_rays, measured_rays, skipped


def scans(*ranges: np.ndarray) -> list:
    return [recorded(r).scan for r in ranges]


def test_returns_near_the_sensor_and_holes_among_them_say_nothing():
    """The roof is seen by the lowest beam in two of three scans; in the third, one of its rays does not return."""
    drives = [room() for _ in range(3)]
    for ranges in drives:
        ranges[0, 10:14] = 2.0
    drives[2][0, 11] = np.nan
    drives[1][2, 90] = np.nan
    drives[0][3, 60] = 1.0
    drives[1][3, 60] = np.nan
    first, second, third = measured_rays(scans(*drives), ego_radius=2.5)
    assert np.argwhere(~first).tolist() == [[0, 10], [0, 11], [0, 12], [0, 13], [3, 60]]
    assert np.argwhere(~second).tolist() == [[0, 10], [0, 11], [0, 12], [0, 13]], "a hole of one scan's return only"
    assert np.argwhere(~third).tolist() == [[0, 10], [0, 11], [0, 12], [0, 13]]


@pytest.mark.parametrize(("first", "count"), [(20, 2), (20, 30), (STEPS - 1, 2), (STEPS - 3, 10)])
def test_sectors_of_five_degrees_without_any_return_were_skipped(first, count):
    """A firing takes 2.5 degrees; a sector may cross the last one."""
    ranges, columns = room(), np.arange(first, first + count) % STEPS
    ranges[:, columns] = np.nan
    out = skipped(recorded(ranges).scan)
    assert sorted(set(np.argwhere(out)[:, 1].tolist())) == sorted(columns.tolist()) and out.sum() == count * len(BEAMS)


def test_narrow_gaps_gaps_of_some_beams_and_empty_scans_were_not():
    narrow, some = room(), room()
    narrow[:, [20, 30, 31 + STEPS // 2]] = np.nan
    some[:3, 20:60] = np.nan
    for ranges in (narrow, some, np.full_like(some, np.nan)):
        assert not skipped(recorded(ranges).scan).any()


def poses(count: int, metres: float) -> list[np.ndarray]:
    """Along x, evenly spaced over `metres`."""
    places = np.tile(np.eye(4), (count, 1, 1))
    places[:, 0, 3] = np.linspace(0.0, metres, count)
    return list(places)


def test_rays_that_never_return_below_the_horizontal_are_blocked():
    """Cells of the lowest beam and of the highest one lack returns in all training scans; one cell in all but one. A
    held-out scan that returns there changes nothing, and its ray is blocked, too."""
    drives = [room() for _ in range(12)]
    for ranges in drives:
        ranges[0, 10:14] = ranges[0, 40] = ranges[len(BEAMS) - 1, 20:30] = np.nan
    drives[3][0, 40] = 8.0
    drives[11][0, 12] = 3.0
    assert BEAMS[0] < 0 < BEAMS[-1]
    found = blocked_rays(scans(*drives), poses(12, 20.0), [True] * 11 + [False])
    assert len(found) == 12
    for blocked in found:
        assert np.argwhere(blocked).tolist() == [[0, step] for step in range(10, 14)]


def test_beams_that_mostly_do_not_return_are_not_blocked():
    drives = [room() for _ in range(12)]
    for ranges in drives:
        ranges[0, : STEPS * 2 // 3] = np.nan
    assert not any(blocked.any() for blocked in blocked_rays(scans(*drives), poses(12, 20.0), [True] * 12))
