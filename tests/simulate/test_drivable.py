"""The drivable area beside a path, on hand-made surfaces."""

import numpy as np
import torch

from drivesplat.model.height_field import HeightField
from drivesplat.scene.rigid import rigid
from drivesplat.simulate.drivable import DrivableStrip, drivable_strip
from drivesplat.trajectories.reference_path import ReferencePath

EDGE = 0.5


def path_of(places: np.ndarray) -> ReferencePath:
    poses = rigid(np.tile(np.eye(3), (len(places), 1, 1)), np.column_stack([places, np.zeros(len(places))]))
    return ReferencePath(poses, np.arange(float(len(places))))


PATH = path_of(np.column_stack([np.arange(0.0, 40.0, 0.1), np.zeros(400)]))


def surface(covered: np.ndarray) -> HeightField:
    """A flat surface from (-10, -10), with these cells covered."""
    heights = torch.zeros(covered.shape[0] + 1, covered.shape[1] + 1)
    return HeightField(torch.tensor([-10.0, -10.0]), EDGE, heights, torch.from_numpy(covered))


def road(left: float, right: float, first: float = -10.0, last: float = 50.0) -> np.ndarray:
    """Cells of a road along x between these metres to the left and right of the path."""
    x, y = np.meshgrid(-10.0 + EDGE * (np.arange(120) + 0.5), -10.0 + EDGE * (np.arange(40) + 0.5), indexing="ij")
    return (y < left) & (y > -right) & (x > first) & (x < last)


def drivable(strip: DrivableStrip, *places: tuple[float, float]) -> list[bool]:
    return strip(np.array(places)).tolist()


def test_the_road_is_drivable_as_wide_as_it_is_known_on_each_side():
    strip = DrivableStrip(PATH, surface(road(6.0, 3.0)))
    assert drivable(strip, (20.0, 5.5), (20.0, 6.5), (20.0, -2.5), (20.0, -3.5), (20.0, 0.0)) == [
        True, False, True, False, True
    ]  # fmt: skip


def test_before_and_behind_what_is_known_the_nearest_known_width_holds():
    strip = DrivableStrip(PATH, surface(road(6.0, 3.0, first=15.0, last=25.0)))
    assert drivable(strip, (0.0, 5.5), (38.0, 5.5), (0.0, 6.5), (38.0, -3.5)) == [True, True, False, False]


def test_a_gap_beside_the_vehicle_is_closed_and_a_narrow_place_far_from_wide_ones_is_not():
    cells = road(6.0, 6.0)
    cells[40:50] = False  # 5 m without any
    assert drivable(DrivableStrip(PATH, surface(cells)), (12.5, 5.5)) == [True]
    narrow = road(6.0, 6.0, last=10.0) | road(3.0, 3.0)
    strip = DrivableStrip(PATH, surface(narrow))
    assert drivable(strip, (5.0, 5.0), (35.0, 5.0), (35.0, 2.9)) == [True, False, True]


def test_where_the_recorded_vehicle_drove_is_drivable_even_where_no_surface_is_known():
    strip = DrivableStrip(PATH, surface(road(0.5, 0.5)))
    assert drivable(strip, (20.0, 1.9), (20.0, -1.9), (20.0, 2.1)) == [True, True, False]


def test_a_bent_path_has_its_road_with_it():
    angles = np.linspace(0.0, np.pi / 2, 300)
    bend = 20.0 * np.column_stack([np.sin(angles), 1 - np.cos(angles)])
    x, y = np.meshgrid(-10.0 + EDGE * (np.arange(120) + 0.5), -10.0 + EDGE * (np.arange(80) + 0.5), indexing="ij")
    radius = np.hypot(x, y - 20.0)
    strip = DrivableStrip(path_of(bend), surface((radius > 16.0) & (radius < 23.0)))
    middle = np.array([np.sin(np.pi / 4), 1 - np.cos(np.pi / 4)])
    outward = np.array([np.sin(np.pi / 4), -np.cos(np.pi / 4)])
    places = [20.0 * middle + shift * outward for shift in (2.5, 4.0, -3.5, -5.0)]
    assert strip(np.array(places)).tolist() == [True, False, True, False]


def test_without_a_known_surface_there_is_no_area():
    assert drivable_strip(PATH, None) is None and drivable_strip(PATH, surface(road(0.0, 0.0))) is None
