"""Errors measured on a GPU equal those measured on a CPU."""

import cv2
import numpy as np
import pytest
import torch

from drivesplat.evaluation.metrics import RegionMetrics, error_maps, gpu_error_sums


def pair(h: int, w: int) -> tuple[np.ndarray, np.ndarray]:
    """A smooth rendering, in part outside [0, 1], and a true image that differs from it by colours and noise."""
    random = np.random.default_rng(h * w)
    image = 1.6 * cv2.GaussianBlur(random.random((h, w, 3)), (0, 0), 2).astype(np.float32) - 0.3
    return image, (0.8 * image + 0.1 + 0.05 * random.random((h, w, 3))).clip(0.0, 1.0)


@pytest.mark.parametrize("size", [(90, 160), (7, 4), (1, 30)])
def test_sums_over_masks_equal_those_of_the_maps(size):
    random, (image, truth) = np.random.default_rng(1), pair(*size)
    masks = [random.random(size) < share for share in (0.0, 0.5, 1.0)]
    everything = random.random(size) < 0.9
    found = gpu_error_sums(image, truth, everything, masks, torch.device("cpu"))
    maps = error_maps(image, truth, everything)
    np.testing.assert_allclose(found, [[values[mask].sum() for values in maps] for mask in masks], rtol=2e-6)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU that torch can use")
def test_figures_of_a_gpu_equal_those_of_a_cpu():
    image, truth = pair(120, 200)
    masks = {"all": np.ones((120, 200), bool), "static": truth[..., 0] > 0.4}
    found = []
    for device in ("cpu", "cuda"):
        metrics = RegionMetrics(lambda a, b: (a - b)[..., 0] ** 2, masks, torch.device(device))
        metrics.add(metrics.measure(image, truth, masks))
        found.append(metrics.summary())
    for region in masks:
        for name, value in found[0][region].items():
            assert found[1][region][name] == pytest.approx(value, rel=1e-6), (region, name)
