"""The record of a scan: directions and points of its rays."""

import numpy as np

from drivesplat.scene.scan import Scan, ScanRays


def scan() -> Scan:
    azimuths = np.array([[0.0, 0.5 * np.pi, -np.pi], [0.0, 0.5 * np.pi, -np.pi]], np.float32)
    elevations = np.array([[0.0], [np.pi / 6.0]], np.float32).repeat(3, axis=1)
    returned = np.array([[True, True, False], [True, False, True]])
    ranges = np.where(returned, 4.0, 0.0).astype(np.float32)
    return Scan(ScanRays(azimuths, elevations, np.zeros((2, 3), np.float32)), returned, ranges)


def test_azimuths_count_from_x_to_y_and_points_are_the_returns_beam_by_beam():
    directions = [[[1, 0, 0], [0, 1, 0], [-1, 0, 0]], [[0.866, 0, 0.5], [0, 0.866, 0.5], [-0.866, 0, 0.5]]]
    np.testing.assert_allclose(scan().rays.directions(), directions, atol=1e-3)
    np.testing.assert_allclose(scan().points(), [[4, 0, 0], [0, 4, 0], [3.464, 0, 2], [-3.464, 0, 2]], atol=1e-3)
