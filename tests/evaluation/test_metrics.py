"""PSNR, SSIM and the gap, as the evaluation protocol defines them, and the worked examples in docstrings."""

import doctest
import json
import math
from typing import Any

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from drivesplat.errors import DriveSplatError
from drivesplat.evaluation import comparison, metrics
from drivesplat.evaluation.evaluate import findings
from drivesplat.evaluation.metrics import RegionMetrics, psnr, ssim_map, with_gap
from drivesplat.scene.regions import LABELS, REGIONS, region_masks

HEIGHT, WIDTH = 40, 50


def pair(seed: int, noise: float = 0.1) -> tuple[np.ndarray, np.ndarray]:
    """A rendered and a recorded image."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform(0.2, 0.8, (HEIGHT, WIDTH, 3))
    return np.clip(truth + noise * rng.normal(size=truth.shape), 0, 1), truth


def labels_of(**pixels: int) -> np.ndarray:
    """A label image with the given number of pixels of each label, the rest static."""
    flat = np.full(HEIGHT * WIDTH, LABELS["static"], dtype=np.uint8)
    start = 0
    for name, count in pixels.items():
        flat[start : start + count] = LABELS[name]
        start += count
    return flat.reshape(HEIGHT, WIDTH)


def measured(*frames: tuple[np.ndarray, np.ndarray, np.ndarray], lpips_map: Any = None) -> dict[str, Any]:
    metrics = RegionMetrics(lpips_map)
    for frame in frames:
        image, truth, labels = frame
        metrics.add(metrics.measure(image, truth, region_masks(labels)))
    return with_gap(metrics.summary())


@pytest.mark.parametrize(("offset", "expected"), [(0.1, 20.0), (1e-4, 80.0)])
def test_the_psnr_of_a_constant_offset_equals_the_closed_form(offset, expected):
    """Colours are not quantised."""
    assert psnr(offset**2) == pytest.approx(expected) and psnr(0.0) is None
    truth = np.full((HEIGHT, WIDTH, 3), 0.4)
    result = measured((truth + offset, truth, labels_of()))["all"]
    assert result["psnr"] == pytest.approx(expected) == result["psnr_frame_mean"]
    assert result["pixels"] == HEIGHT * WIDTH and result["lpips"] is None and "identical" not in result


@pytest.mark.parametrize("pixels", [[0], [999], [1000], [400, 400], [400, 400, 400]])
def test_a_region_of_fewer_than_1000_pixels_in_all_frames_together_is_null(pixels):
    frames = [(*pair(seed), labels_of(moving_car=count)) for seed, count in enumerate(pixels)]
    record = measured(*frames)["moving_vehicle"]
    assert (record and record["pixels"]) == (sum(pixels) if sum(pixels) >= 1000 else None)


def test_psnr_is_pooled_over_frames_and_the_frame_mean_leaves_out_those_with_few_pixels():
    truth = np.full((HEIGHT, WIDTH, 3), 0.3)
    record = measured(*((truth + offset, truth, labels_of()) for offset in (0.1, 0.01)))["all"]
    assert record["psnr"] == pytest.approx(-10 * math.log10((0.01 + 0.0001) / 2))
    assert record["psnr_frame_mean"] == pytest.approx((20.0 + 40.0) / 2)
    sizes = ((0.1, 1200), (0.2, 99), (0.01, 100))
    record = measured(*((truth + offset, truth, labels_of(moving_car=count)) for offset, count in sizes))
    assert record["moving_vehicle"]["psnr_frame_mean"] == pytest.approx((20.0 + 40.0) / 2)
    assert record["moving_vehicle"]["pixels"] == 1399


def test_psnr_cc_is_that_of_the_image_after_an_affine_map_of_its_colours():
    """Fitted over all measured pixels of each image, before regions are taken."""
    image, truth = pair(3)
    labels = labels_of(moving_car=1200, own_car=300)
    tinted = 0.8 * truth @ np.array([[0.9, 0.1, 0.0], [0.0, 1.0, 0.1], [0.1, 0.0, 0.8]]) + 0.05
    tinted[labels == LABELS["own_car"]] = 1.0
    records = measured((tinted, truth, labels))
    assert records["all"]["psnr"] < 30
    assert records["all"]["psnr_cc"] > 100 and records["moving_vehicle"]["psnr_cc"] > 100
    every = (labels != LABELS["own_car"]).ravel()
    known = np.column_stack([image.reshape(-1, 3), np.ones(image.size // 3)])
    fit = np.linalg.lstsq(known[every], truth.reshape(-1, 3)[every], rcond=None)[0]
    car = (labels == LABELS["moving_car"]).ravel()
    expected = peak_signal_noise_ratio(truth.reshape(-1, 3)[car], (known @ fit).clip(0, 1)[car], data_range=1.0)
    assert measured((image, truth, labels))["moving_vehicle"]["psnr_cc"] == pytest.approx(expected)
    constant = np.full_like(truth, 0.4)
    assert measured((constant + 0.1, constant, labels_of()))["all"]["psnr_cc"] > 100, "one colour alone is corrected"
    assert measured((truth, truth, labels_of()))["all"]["psnr_cc"] is None


def fake_lpips(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """A replacement for the LPIPS map: an arbitrary function of two images, per pixel."""
    return np.abs(image - truth).max(axis=2) + 0.25 * truth[..., 0]


def test_pooled_figures_equal_those_of_the_concatenated_pixels():
    rng = np.random.default_rng(3)
    frames = [(*pair(seed), rng.integers(0, len(LABELS), (HEIGHT, WIDTH)).astype(np.uint8)) for seed in range(4)]
    result = measured(*frames, lpips_map=fake_lpips)
    assert result.keys() == {*REGIONS, "gap_db", "human_gap_db"}
    for region, names in REGIONS.items():
        masks = [np.isin(labels, [LABELS[name] for name in names]) for _, _, labels in frames]
        if sum(mask.sum() for mask in masks) < 1000:
            assert result[region] is None
            continue

        def pooled(per_pixel, masks=masks):
            return np.concatenate([per_pixel(i, t)[m] for (i, t, _), m in zip(frames, masks, strict=True)])

        errors, perceptual = pooled(lambda i, t: (i - t) ** 2), pooled(fake_lpips)
        assert result[region]["psnr"] == pytest.approx(-10 * math.log10(errors.mean()), abs=1e-9)
        assert result[region]["ssim"] == pytest.approx(pooled(skimage_ssim).mean(), abs=1e-6)
        assert result[region]["lpips"] == pytest.approx(perceptual.mean(), abs=1e-9)
        assert result[region]["pixels"] == len(perceptual)


@pytest.mark.parametrize(
    ("label", "regions"),
    [
        ("static", {"all", "static"}),
        ("left_out", {"all"}),
        ("other", {"all"}),
        ("parked_car", {"all", "vehicle", "car", "parked_vehicle"}),
        ("moving_car", {"all", "vehicle", "car", "moving_vehicle"}),
        ("parked_other_vehicle", {"all", "vehicle", "parked_vehicle"}),
        ("moving_other_vehicle", {"all", "vehicle", "moving_vehicle"}),
        ("still_human", {"all"}),
        ("moving_human", {"all", "moving_human"}),
        ("own_car", set()),
    ],
)
def test_a_pixel_counts_in_the_regions_of_its_label(label, regions):
    result = measured((*pair(5), labels_of(**{label: HEIGHT * WIDTH})))
    assert {region for region in REGIONS if result[region] is not None} == regions


def skimage_ssim(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    options = {"data_range": 1.0, "channel_axis": 2, "gaussian_weights": True, "sigma": 1.5, "full": True}
    return structural_similarity(image, truth, use_sample_covariance=False, **options)[1].mean(axis=2)


def test_psnr_and_the_ssim_map_equal_those_of_skimage():
    for noise in (0.02, 0.3):
        image, truth = pair(6, noise)
        expected = peak_signal_noise_ratio(truth, image, data_range=1.0)
        assert measured((image, truth, labels_of()))["all"]["psnr"] == pytest.approx(expected)
        np.testing.assert_allclose(ssim_map(image, truth), skimage_ssim(image, truth), atol=1e-5)


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0])
def test_the_ssim_map_is_accurate_where_images_are_even(level):
    """Variances near 0, at which single precision loses most; black and white, half a step of 8 bits apart."""
    rng = np.random.default_rng(7)
    truth = np.full((40, 60, 3), level)
    image = (truth + rng.normal(scale=0.002, size=truth.shape)).clip(0.0, 1.0)
    np.testing.assert_allclose(ssim_map(image, truth), skimage_ssim(image, truth), atol=1e-4)
    np.testing.assert_array_equal(ssim_map(truth, truth), 1.0)


def test_without_frames_all_figures_are_null_and_none_is_ever_nan_or_infinite():
    assert set(measured().values()) == {None}
    black, white, some = np.zeros((HEIGHT, WIDTH, 3)), np.ones((HEIGHT, WIDTH, 3)), pair(9)
    for frames in (
        [(black, black, labels_of())],
        [(white, black, labels_of())],
        [(*some, labels_of(own_car=HEIGHT * WIDTH))],
        [(*some, labels_of(moving_car=1500)), (*some, labels_of(moving_car=50))],
    ):
        json.dumps(measured(*frames), allow_nan=False)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_rendering_with_nan_or_infinity_never_scores_well(bad):
    """It is refused or scores like the worst colour; it is neither identical nor NaN."""
    image, truth = pair(10)
    image[3, 4, 1] = bad
    try:
        record = measured((image, truth, labels_of()))["all"]
    except DriveSplatError:
        return
    assert record["psnr"] is not None and math.isfinite(record["psnr"])
    assert math.isfinite(record["ssim"])


@pytest.mark.parametrize(
    ("static", "moving", "vehicle", "expected"),
    [
        pytest.param({"psnr": 25.0}, {"psnr": 17.0}, {"psnr": 19.0}, 8.0, id="static minus moving vehicles"),
        pytest.param({"psnr": 25.0}, None, {"psnr": 19.0}, 6.0, id="all vehicles where nothing moves"),
        pytest.param({"psnr": 15.0}, {"psnr": 17.0}, {"psnr": 19.0}, -2.0, id="negative where vehicles are better"),
        pytest.param({"psnr": 25.0}, None, None, None, id="no vehicle"),
        pytest.param(None, {"psnr": 17.0}, {"psnr": 19.0}, None, id="nothing static"),
        pytest.param({"psnr": None}, {"psnr": 17.0}, {"psnr": 19.0}, None, id="static identical"),
        pytest.param({"psnr": 25.0}, {"psnr": None}, {"psnr": 19.0}, None, id="moving identical"),
    ],
)
def test_gap_is_static_minus_moving(static, moving, vehicle, expected):
    regions = {"static": static, "moving_vehicle": moving, "vehicle": vehicle, "moving_human": None}
    assert with_gap(regions)["gap_db"] == expected


@pytest.mark.parametrize(
    ("static", "vehicle", "expected"),
    [
        ({"psnr": 22.5}, {"psnr": 17.5}, (True, True)),
        ({"psnr": 21.5}, {"psnr": 18.5}, (False, False)),
        ({"psnr": 22.0}, {"psnr": 18.0}, (False, False)),
        (None, {"psnr": 17.0}, (None, True)),
        ({"psnr": 23.0}, None, (True, None)),
        ({"psnr": None}, {"psnr": None}, (None, None)),
    ],
)
def test_findings_are_null_where_a_region_is(static, vehicle, expected):
    found = findings({"static": static, "vehicle": vehicle})
    assert (found["static_above_22_db"], found["vehicle_below_18_db"]) == expected


@pytest.mark.parametrize("module", [comparison, metrics], ids=lambda module: module.__name__)
def test_worked_examples_are_correct(module):
    result = doctest.testmod(module)
    assert result.attempted and not result.failed
