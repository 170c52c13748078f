"""PSNR, SSIM and the gap, as the evaluation protocol defines them."""

import json
import math
from typing import Any

import numpy as np
import pytest
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from drivesplat.errors import DriveSplatError
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


@pytest.mark.parametrize(("error", "expected"), [(1.0, 0.0), (0.1, 10.0), (0.01, 20.0), (2.5e-3, 26.0206)])
def test_psnr_of_a_squared_error(error, expected):
    assert psnr(error) == pytest.approx(expected, abs=1e-4)


def test_psnr_of_zero_error_is_none():
    assert psnr(0.0) is None


def test_the_psnr_of_a_constant_offset_equals_the_closed_form():
    truth = np.full((HEIGHT, WIDTH, 3), 0.4)
    result = measured((truth + 0.1, truth, labels_of()))
    assert result["all"]["psnr"] == pytest.approx(20.0)
    assert result["all"]["psnr_frame_mean"] == pytest.approx(20.0)
    assert result["all"]["pixels"] == HEIGHT * WIDTH


def test_psnr_equals_that_of_skimage():
    image, truth = pair(0)
    expected = peak_signal_noise_ratio(truth, image, data_range=1.0)
    assert measured((image, truth, labels_of()))["all"]["psnr"] == pytest.approx(expected)


def test_images_that_differ_are_not_called_identical():
    assert "identical" not in measured((*pair(1), labels_of()))["all"]


def test_colours_are_not_quantised():
    truth = np.full((HEIGHT, WIDTH, 3), 0.5)
    assert measured((truth + 1e-4, truth, labels_of()))["all"]["psnr"] == pytest.approx(80.0)


@pytest.mark.parametrize(("pixels", "kept"), [(0, False), (999, False), (1000, True)])
def test_a_region_of_fewer_than_1000_pixels_is_null(pixels, kept):
    record = measured((*pair(2), labels_of(moving_car=pixels)))["moving_vehicle"]
    assert (record is not None) is kept
    if kept:
        assert record["pixels"] == pixels


def test_the_minimum_of_1000_pixels_applies_to_all_frames_together():
    frames = [(*pair(seed), labels_of(moving_human=400)) for seed in range(3)]
    assert measured(*frames[:2])["moving_human"] is None
    assert measured(*frames)["moving_human"]["pixels"] == 1200


def test_psnr_is_pooled_over_frames_and_the_frame_mean_is_not():
    truth = np.full((HEIGHT, WIDTH, 3), 0.3)
    frames = [(truth + offset, truth, labels_of()) for offset in (0.1, 0.01)]
    record = measured(*frames)["all"]
    assert record["psnr"] == pytest.approx(-10 * math.log10((0.01 + 0.0001) / 2))
    assert record["psnr_frame_mean"] == pytest.approx((20.0 + 40.0) / 2)


def test_psnr_cc_is_that_of_the_image_after_an_affine_map_of_its_colours():
    """Fitted over all measured pixels of each image, before regions are taken."""
    image, truth = pair(3)
    labels = labels_of(moving_car=1200, own_car=300)
    tinted = 0.8 * truth @ np.array([[0.9, 0.1, 0.0], [0.0, 1.0, 0.1], [0.1, 0.0, 0.8]]) + 0.05
    tinted[labels == LABELS["own_car"]] = 1.0
    records = measured((tinted, truth, labels))
    assert (
        records["all"]["psnr"] < 30 and records["all"]["psnr_cc"] > 100 and records["moving_vehicle"]["psnr_cc"] > 100
    )
    every = (labels != LABELS["own_car"]).ravel()
    known = np.column_stack([image.reshape(-1, 3), np.ones(image.size // 3)])
    fit = np.linalg.lstsq(known[every], truth.reshape(-1, 3)[every], rcond=None)[0]
    car = (labels == LABELS["moving_car"]).ravel()
    expected = peak_signal_noise_ratio(truth.reshape(-1, 3)[car], (known @ fit).clip(0, 1)[car], data_range=1.0)
    assert measured((image, truth, labels))["moving_vehicle"]["psnr_cc"] == pytest.approx(expected)
    constant = np.full_like(truth, 0.4)
    assert measured((constant + 0.1, constant, labels_of()))["all"]["psnr_cc"] > 100, "one colour alone is corrected"
    assert measured((truth, truth, labels_of()))["all"]["psnr_cc"] is None


def test_a_frame_with_fewer_than_100_pixels_of_a_region_is_left_out_of_its_frame_mean():
    truth = np.full((HEIGHT, WIDTH, 3), 0.3)
    frames = [
        (truth + 0.1, truth, labels_of(moving_car=1200)),
        (truth + 0.2, truth, labels_of(moving_car=99)),
        (truth + 0.01, truth, labels_of(moving_car=100)),
    ]
    record = measured(*frames)["moving_vehicle"]
    assert record["psnr_frame_mean"] == pytest.approx((20.0 + 40.0) / 2)
    assert record["pixels"] == 1399


def fake_lpips(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """A replacement for the LPIPS map: an arbitrary function of two images, per pixel."""
    return np.abs(image - truth).max(axis=2) + 0.25 * truth[..., 0]


def test_pooled_figures_equal_those_of_the_concatenated_pixels():
    rng = np.random.default_rng(3)
    frames = [(*pair(seed), rng.integers(0, len(LABELS), (HEIGHT, WIDTH)).astype(np.uint8)) for seed in range(4)]
    result = measured(*frames, lpips_map=fake_lpips)
    for region, names in REGIONS.items():
        masks = [np.isin(labels, [LABELS[name] for name in names]) for _, _, labels in frames]
        if sum(mask.sum() for mask in masks) < 1000:
            assert result[region] is None
            continue
        errors = np.concatenate([((i - t) ** 2)[m] for (i, t, _), m in zip(frames, masks, strict=True)])
        maps = [
            structural_similarity(
                i, t, data_range=1.0, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
                full=True,
            )[1]
            for i, t, _ in frames
        ]  # fmt: skip
        similarity = np.concatenate([s[m] for s, m in zip(maps, masks, strict=True)])
        perceptual = np.concatenate([fake_lpips(i, t)[m] for (i, t, _), m in zip(frames, masks, strict=True)])
        assert result[region]["psnr"] == pytest.approx(-10 * math.log10(errors.mean()), abs=1e-9)
        assert result[region]["ssim"] == pytest.approx(similarity.mean(), abs=1e-6)
        assert result[region]["lpips"] == pytest.approx(perceptual.mean(), abs=1e-9)
        assert result[region]["pixels"] == len(perceptual)


def test_regions_follow_the_protocol():
    regions = {"all", "static", "vehicle", "car", "moving_vehicle", "parked_vehicle", "moving_human"}
    assert measured((*pair(4), labels_of())).keys() == {*regions, "gap_db", "human_gap_db"}


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
    _, expected = structural_similarity(
        image, truth, data_range=1.0, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        full=True,
    )  # fmt: skip
    return expected.mean(axis=2)


@pytest.mark.parametrize("noise", [0.02, 0.3])
def test_the_ssim_map_equals_that_of_skimage(noise):
    image, truth = pair(6, noise)
    np.testing.assert_allclose(ssim_map(image, truth), skimage_ssim(image, truth), atol=1e-5)


@pytest.mark.parametrize("level", [0.0, 0.02, 0.5, 0.98, 1.0])
def test_the_ssim_map_is_accurate_where_images_are_even(level):
    """Variances near 0, at which single precision loses most; black and white, half a step of 8 bits apart."""
    rng = np.random.default_rng(7)
    truth = np.full((40, 60, 3), level)
    image = (truth + rng.normal(scale=0.002, size=truth.shape)).clip(0.0, 1.0)
    np.testing.assert_allclose(ssim_map(image, truth), skimage_ssim(image, truth), atol=1e-4)
    np.testing.assert_array_equal(ssim_map(truth, truth), 1.0)


def test_without_a_map_lpips_is_null():
    assert measured((*pair(7), labels_of()))["all"]["lpips"] is None


def test_without_frames_all_figures_are_null():
    assert set(measured().values()) == {None}


@pytest.mark.parametrize(
    "frames",
    [
        pytest.param([], id="no frame"),
        pytest.param([(np.zeros((HEIGHT, WIDTH, 3)), np.zeros((HEIGHT, WIDTH, 3)), labels_of())], id="black"),
        pytest.param([(np.ones((HEIGHT, WIDTH, 3)), np.zeros((HEIGHT, WIDTH, 3)), labels_of())], id="inverse"),
        pytest.param([(*pair(9), labels_of(own_car=HEIGHT * WIDTH))], id="the ego vehicle alone"),
        pytest.param([(*pair(9), labels_of(moving_car=1500)), (*pair(9), labels_of(moving_car=50))], id="little"),
    ],
)
def test_no_figure_is_nan_or_infinite(frames):
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


def record_of(value: float | None) -> dict[str, Any]:
    return {"psnr": value}


@pytest.mark.parametrize(
    ("static", "moving", "vehicle", "expected"),
    [
        pytest.param(record_of(25.0), record_of(17.0), record_of(19.0), 8.0, id="static minus moving vehicles"),
        pytest.param(record_of(25.0), None, record_of(19.0), 6.0, id="all vehicles where nothing moves"),
        pytest.param(record_of(15.0), record_of(17.0), record_of(19.0), -2.0, id="negative where vehicles are better"),
        pytest.param(record_of(25.0), None, None, None, id="no vehicle"),
        pytest.param(None, record_of(17.0), record_of(19.0), None, id="nothing static"),
        pytest.param(record_of(None), record_of(17.0), record_of(19.0), None, id="static identical"),
        pytest.param(record_of(25.0), record_of(None), record_of(19.0), None, id="moving identical"),
    ],
)
def test_gap_is_static_minus_moving(static, moving, vehicle, expected):
    regions = {"static": static, "moving_vehicle": moving, "vehicle": vehicle, "moving_human": None}
    assert with_gap(regions)["gap_db"] == expected


@pytest.mark.parametrize(
    ("static", "vehicle", "expected"),
    [
        (record_of(22.5), record_of(17.5), (True, True)),
        (record_of(21.5), record_of(18.5), (False, False)),
        (record_of(22.0), record_of(18.0), (False, False)),
        (None, record_of(17.0), (None, True)),
        (record_of(23.0), None, (True, None)),
        (record_of(None), record_of(None), (None, None)),
    ],
)
def test_findings_are_null_where_a_region_is(static, vehicle, expected):
    found = findings({"static": static, "vehicle": vehicle})
    assert (found["static_above_22_db"], found["vehicle_below_18_db"]) == expected
