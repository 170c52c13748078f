"""Held-out LiDAR scans as a picture: which scans it shows, and what it says of them."""

import dataclasses

import numpy as np
import pytest
from helpers.scan_drives import BEAMS, KEY_FRAME_US, STEPS, recorded, room, scene_of, track_of

from drivesplat.errors import ResultError
from drivesplat.evaluation.scan_metrics import scan_metrics
from drivesplat.scene.scan import RenderedScan
from drivesplat.scene.scan_record import NO_OBJECT, ScanRecords
from drivesplat.visuals.lidar_picture import draw_held_out_scans, figures_label, sample_scans, scan_label
from drivesplat.visuals.trained_lidar import heading, main_scans

TRACK = track_of("car", [(5.0 * i, 0.0, 0.0) for i in range(8)])
SCENE = dataclasses.replace(scene_of([], TRACK), key_frame_timestamps=np.arange(8) * KEY_FRAME_US)


def test_the_picture_has_a_scan_of_each_group_with_its_figures(lidar_of):
    lidar = lidar_of(drive())
    figure = draw_held_out_scans(lidar, "mine")
    assert figure.get_suptitle() == "Scene hand · mine · top"
    titles = [part.get_suptitle() for part in figure.subfigs]
    expected = [scan_label(one) for one in sample_scans(SCENE, lidar.scans)]
    assert [title.split(": ")[0] for title in titles] == expected and len(titles) == 2
    assert all("range off by 10.0 cm" in title for title in titles)
    lidar = lidar_of(drive(), RenderedScan(room(np.nan), np.zeros(room().shape)))
    with pytest.raises(ResultError, match=r"LiDAR scan contains NaN or Inf; delete checkpoint\.npz"):
        draw_held_out_scans(lidar, "mine")


def test_the_lidar_with_most_rays_is_shown_in_order_of_time_and_its_heading_is_that_of_travel():
    """The mean direction of travel in the sensor's frame: nuScenes' LiDAR has its y axis ahead."""
    small = [scan(i, "train", lidar="side") for i in range(2)]
    large = [scan(i, "train", linear=np.array([0.1 * (-1) ** i, 8.0, 0.0])) for i in (3, 1, 2, 0)]
    main = main_scans(ScanRecords([*small, *large], []))
    assert [one.sample_index for one in main] == [0, 1, 2, 3]
    standing = scan(5, "train", linear=np.array([-0.3, 0.0, 0.0]))
    assert heading([*main, standing]) == pytest.approx(np.pi / 2)
    assert heading([standing]) is None


GROUPS = ("train", "interpolation", "train", "interpolation", "interpolation", "extrapolation", "extrapolation")


def scan(key_frame: int, group: str, on_car: int = 0, **more):
    objects = np.full((len(BEAMS), STEPS), NO_OBJECT, dtype=np.int16)
    objects[0, :on_car] = 0
    made = recorded(room(), timestamp=key_frame * KEY_FRAME_US, group=group, objects=objects)
    return dataclasses.replace(made, **more)


def drive(on_car: dict[int, int] | None = None) -> list:
    return [scan(i, group, (on_car or {}).get(i, 0)) for i, group in enumerate(GROUPS)]


def test_the_scan_with_most_returns_from_moving_vehicles_is_shown_of_each_group():
    def shown(scans):
        return [one.sample_index for one in sample_scans(SCENE, scans)]

    assert shown(drive({1: 20, 4: 30, 6: 5, 2: 99})) == [4, 6]
    assert shown(drive()) == [3, 6], "the middle ones where nothing moves"
    assert shown(drive()[:5]) == [3], "a group without scans has none"
    assert shown([scan(i, "train") for i in range(3)]) == [1]


def test_labels_say_what_is_held_out_and_the_figures_that_exist():
    assert scan_label(scan(4, "interpolation")) == "Key frame 4, held out between training frames"
    between = scan(3, "extrapolation", is_key_frame=False, seconds=1.52)
    assert scan_label(between) == "1.52 s, held out beyond the last training frame"
    assert scan_label(scan(0, "train")) == "Key frame 0, training scan"
    rendered = RenderedScan(room(12.1), np.zeros(room().shape), np.full(room().shape, 0.4))
    said = figures_label(scan_metrics(SCENE, [(scan(1, "train"), rendered)])["all"])
    assert said == "range off by 10.0 cm (median), intensity by 0.100 (RMSE), 100.0 % of returns and drops right"
    nothing = dataclasses.replace(rendered, drops=np.ones(room().shape))
    assert (
        figures_label(scan_metrics(SCENE, [(scan(1, "train"), nothing)])["all"]) == "0.0 % of returns and drops right"
    )
    few = recorded(room(), measured=np.zeros(room().shape, dtype=bool))
    assert figures_label(scan_metrics(SCENE, [(few, rendered)])["all"]) == "no figures, fewer than 100 measured rays"
