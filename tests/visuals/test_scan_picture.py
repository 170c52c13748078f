"""The picture of a LiDAR scan: its rows, their order, and what is shown of rays without a return."""

import numpy as np
import pytest
from helpers.scan_drives import STEPS, recorded, room
from matplotlib.image import AxesImage
from PIL import Image

from drivesplat.scene.scan import RenderedScan
from drivesplat.visuals.figures import save_figure
from drivesplat.visuals.scan_picture import ShownScan, draw_scans

TITLES = [
    "Range, recorded", "Range, rendered", "Error of range, where both return", "Intensity, recorded",
    "Intensity, rendered", "No return, recorded", "Probability of no return, rendered",
]  # fmt: skip


@pytest.fixture
def pair():
    """A scan with a hole and a ray that says nothing, and a rendering that is 1 m off."""
    ranges = room()
    ranges[3, 0] = np.nan  # the highest beam, straight behind
    measured = np.ones(ranges.shape, dtype=bool)
    measured[0, 10] = False
    drops = np.full(ranges.shape, 0.25)
    drops[1, 20] = 0.75
    return recorded(ranges, measured=measured), RenderedScan(room(13.0), drops, np.full(ranges.shape, 0.4))


def column(firing: int) -> int:
    """Where a firing is shown: the first looks straight behind."""
    return (STEPS - firing) % STEPS


def images(figure) -> dict[str, AxesImage]:
    return {axis.get_title(loc="left"): axis.images[0] for axis in figure.axes if axis.get_title(loc="left")}


def test_rows_show_values_with_the_highest_beam_above_and_azimuth_clockwise(pair, tmp_path):
    figure = draw_scans([ShownScan(*pair, "a scan")])
    shown = {title: image.get_array() for title, image in images(figure).items()}
    assert list(shown) == TITLES
    recorded_range, error, drop = (shown[TITLES[i]] for i in (0, 2, 6))
    assert recorded_range.shape == (4, STEPS)
    assert recorded_range.mask[0, column(0)] and recorded_range.mask.sum() == 2, "a hole, and a ray that says nothing"
    assert recorded_range.mask[3, column(10)] and error.mask[3, column(10)]
    np.testing.assert_allclose(error.compressed(), 1.0, atol=1e-4)
    assert error.mask.sum() == 3 and error.mask[2, column(20)], "a drop is predicted there"
    assert drop[2, column(20)] == 0.75 and shown["No return, recorded"][0, column(0)] == 1.0
    save_figure(tmp_path / "scan.png", figure)
    assert Image.open(tmp_path / "scan.png").size[0] == 1600


def test_no_return_has_a_colour_of_its_own_and_rows_of_intensities_that_are_not_there_are_left_out(pair):
    """Neither the nearest nor the farthest range, the smallest error nor the lowest intensity is as black."""
    for image in list(images(draw_scans([ShownScan(*pair, "")])).values())[:5]:
        assert image.get_cmap()(np.linspace(0.0, 1.0, 9))[:, :3].sum(axis=1).min() > 0.3
    without = images(draw_scans([ShownScan(recorded(room(), intensity=None), pair[1], "")]))
    assert list(without) == [title for title in TITLES if title != "Intensity, recorded"]
