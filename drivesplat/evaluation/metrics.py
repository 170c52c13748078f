"""PSNR, SSIM and LPIPS pooled over regions, and errors of depth, as the measuring protocol defines them.

Maps are computed per frame and summed per region, so memory hardly grows with the number of frames.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from drivesplat.errors import ResultError
from drivesplat.kernels.color_difference import C1, C2, window_taps
from drivesplat.lidar.depth_record import PixelDepths
from drivesplat.scene.regions import REGIONS

MIN_REGION_PIXELS = 1000
"""A region with fewer pixels in a group is null."""
MIN_FRAME_PIXELS = 100
"""A frame with fewer pixels of a region is left out of the region's frame mean."""

MAX_PARALLEL_FRAMES = 8
"""Maximum number of frames measured in parallel; one of 1600x900 takes 0.2 GB."""

LpipsMap = Callable[[np.ndarray, np.ndarray], np.ndarray]


def measuring_threads() -> int:
    """The number of threads that measure frames: that of torch, up to MAX_PARALLEL_FRAMES."""
    return min(MAX_PARALLEL_FRAMES, torch.get_num_threads())


def psnr(squared_error: float) -> float | None:
    """Peak signal-to-noise ratio in dB, -10 log10(MSE), of a mean squared error of values in [0, 1]; None for 0.

    >>> psnr(0.01), psnr(0.0)
    (20.0, None)
    """
    return -10.0 * math.log10(squared_error) if squared_error > 0 else None


def psnr_record(image: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> dict[str, Any] | None:
    """`psnr` in dB between two images (h, w, 3) in [0, 1] over a mask (h, w) bool, `identical` if they are, and
    `pixels`; None for an empty mask."""
    pixels = int(mask.sum())
    if pixels == 0:
        return None
    value = psnr(float(((image - truth)[mask] ** 2).mean()))
    return {"psnr": value, **({"identical": True} if value is None else {}), "pixels": pixels}


def ssim_map(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Structural similarity per pixel (h, w) of two images (h, w, 3) in [0, 1], mean over channels (Wang et al. 2004):
    Gaussian window with sigma 1.5 and 11 taps, no border cropped.

    The map of skimage with `gaussian_weights=True` and `use_sample_covariance=False`, in single precision: means over
    images within 1e-4, pixels within 2e-4. Moments are taken about 0.5, since variances then lose fewer digits.
    """
    x, y = (values.astype(np.float32) - np.float32(0.5) for values in (image, truth))
    means = mean_x, mean_y = _windowed(x), _windowed(y)
    var_x, var_y = (_windowed(values * values) - mean * mean for values, mean in zip((x, y), means, strict=True))
    covariance = _windowed(x * y) - mean_x * mean_y
    return channel_mean(_similarity(mean_x, mean_y, var_x + var_y, covariance))


def _similarity(mean_x: Any, mean_y: Any, variances: Any, covariance: Any) -> Any:
    """Structural similarity from local moments of two images about 0.5: means, the sum of both variances, and the
    covariance; arrays or tensors."""
    mean_x, mean_y = mean_x + 0.5, mean_y + 0.5
    luminance = (2.0 * mean_x * mean_y + C1) / (mean_x * mean_x + mean_y * mean_y + C1)
    return luminance * (2.0 * covariance + C2) / (variances + C2)


def _windowed(values: np.ndarray) -> np.ndarray:
    """Local means (h, w, 3), reflected at the borders."""
    taps = window_taps()
    return cv2.sepFilter2D(values, -1, taps, taps, borderType=cv2.BORDER_REFLECT)


def channel_mean(values: np.ndarray) -> np.ndarray:
    """The mean (h, w) of three channels (h, w, 3): numpy's, which takes ten times as long for an axis this short."""
    return (values[..., 0] + values[..., 1] + values[..., 2]) / 3


def color_corrected(image: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """A rendered image (h, w, 3) after the affine map of colours that brings it closest to the true one over a mask
    (h, w) bool, in least squares; values in [0, 1]. Published figures use it where a camera exposes automatically.

    >>> truth = np.random.default_rng(0).uniform(0.2, 0.8, (8, 8, 3))
    >>> bool(np.allclose(color_corrected(0.5 * truth + 0.1, truth, np.ones((8, 8), bool)), truth))
    True
    """
    rows = np.concatenate([image[mask], np.ones((np.count_nonzero(mask), 1))], axis=1)
    affine = np.linalg.lstsq(rows.T @ rows, rows.T @ truth[mask], rcond=None)[0]
    return (image @ affine[:3] + affine[3]).clip(0.0, 1.0)


def error_maps(image: np.ndarray, truth: np.ndarray, everything: np.ndarray) -> list[np.ndarray]:
    """Maps (h, w) of the squared error of a rendered image (h, w, 3) against the true one, means over channels, of the
    same after the colours were corrected over the mask `everything` (h, w) bool, and of SSIM."""
    image, truth = image.clip(0.0, 1.0).astype(np.float64), truth.astype(np.float64)
    corrected = color_corrected(image, truth, everything)
    return [*(channel_mean((values - truth) ** 2) for values in (image, corrected)), ssim_map(image, truth)]


@torch.no_grad()
def gpu_error_sums(
    image: Float[np.ndarray, "h w 3"],
    truth: Float[np.ndarray, "h w 3"],
    everything: Bool[np.ndarray, "h w"],
    masks: Sequence[Bool[np.ndarray, "h w"]],
    device: torch.device,
) -> list[list[float]]:
    """The sums of the maps of `error_maps` over each of `masks`, computed and added on `device`."""
    found = torch.from_numpy(image).to(device).double().clamp(0.0, 1.0)
    true = torch.from_numpy(truth).to(device).double()
    corrected = _color_corrected_there(found, true, torch.from_numpy(everything).to(device))
    errors = [(values - true).square().mean(dim=2) for values in (found, corrected)]
    maps = torch.stack([*errors, _ssim_map_there(found, true)], dim=-1).reshape(-1, len(errors) + 1)
    weights = torch.from_numpy(np.stack(masks)).to(device).flatten(1).double()
    return (weights @ maps).tolist()


def _color_corrected_there(
    image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    rows = torch.cat([image, torch.ones_like(image[..., :1])], dim=2).flatten(0, 1)
    weighted = (rows * mask.flatten()[:, None]).mT
    normal, right = ((weighted @ values).cpu().numpy() for values in (rows, truth.flatten(0, 1)))
    affine = torch.from_numpy(np.linalg.lstsq(normal, right, rcond=None)[0]).to(image)
    return (image @ affine[:3] + affine[3]).clamp(0.0, 1.0)


def _ssim_map_there(image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w"]:
    x, y = (values.permute(2, 0, 1).float() - 0.5 for values in (image, truth))
    mean_x, mean_y, square_x, square_y, product = _windowed_there(torch.stack([x, y, x * x, y * y, x * y]))
    variances = square_x - mean_x * mean_x + square_y - mean_y * mean_y
    return _similarity(mean_x, mean_y, variances, product - mean_x * mean_y).mean(dim=0)


def _windowed_there(values: Float[Tensor, "k c h w"]) -> Float[Tensor, "k c h w"]:
    """Local means, reflected at the borders. Sums of shifted images: convolutions may round to TF32."""
    taps = window_taps().ravel().tolist()
    for dim in (2, 3):
        size, reach = values.shape[dim], len(taps) // 2
        reflected = torch.from_numpy(np.pad(np.arange(size), reach, mode="symmetric")).to(values.device)
        padded = values.index_select(dim, reflected)
        values = sum((tap * padded.narrow(dim, i, size) for i, tap in enumerate(taps)), torch.zeros_like(values))
    return values


class FrameErrors(NamedTuple):
    """A frame's sums over the `pixels` of a region: squared error, the same after colour correction, SSIM, and LPIPS (0
    where it is not measured)."""

    pixels: int
    squared_error: float
    corrected_error: float
    ssim: float
    lpips: float = 0.0


class RegionMetrics:
    """Metrics of a group of frames, pooled over the pixels of named regions.

    Frames are measured on `device`. A GPU gives the figures of a CPU within rounding.

    >>> metrics = RegionMetrics(lpips_map=None, regions=["all"])
    >>> truth = np.zeros((40, 50, 3))
    >>> metrics.add(metrics.measure(truth + 0.1, truth, {"all": np.ones((40, 50), bool)}))
    >>> round(metrics.summary()["all"]["psnr"], 6)
    20.0
    """

    def __init__(
        self,
        lpips_map: LpipsMap | None,
        regions: Iterable[str] = REGIONS,
        device: torch.device | None = None,
    ):
        self._lpips_map, self._with_lpips, self._device = (
            lpips_map,
            lpips_map is not None,
            device or torch.device("cpu"),
        )
        self._frames: dict[str, list[FrameErrors]] = {region: [] for region in regions}

    def measure(self, image: np.ndarray, truth: np.ndarray, masks: Mapping[str, np.ndarray]) -> dict[str, FrameErrors]:
        """The errors of a rendered image against a true one, both (h, w, 3) in [0, 1], over each region's mask (h, w)
        bool. Colours are corrected over the region `all`. Changes nothing, so several threads may measure frames.

        Raises ResultError if the rendering contains NaN or Inf.
        """
        if not np.isfinite(image).all():
            raise ResultError(
                "the rendering of a held-out image contains NaN or Inf; delete its checkpoint.npz and rerun"
            )
        everything = masks.get("all", np.ones(image.shape[:2], dtype=bool))
        measured = {region: masks[region] for region in self._frames}
        if self._device.type == "cuda":
            sums = gpu_error_sums(image, truth, everything, list(measured.values()), self._device)
        else:
            maps = error_maps(image, truth, everything)
            sums = [[float(values[mask].sum(dtype=np.float64)) for values in maps] for mask in measured.values()]
        if self._lpips_map:
            distance = self._lpips_map(image.clip(0.0, 1.0).astype(np.float64), truth.astype(np.float64))
            for own, mask in zip(sums, measured.values(), strict=True):
                own.append(float(distance[mask].sum(dtype=np.float64)))
        pixels = (int(np.count_nonzero(mask)) for mask in measured.values())
        return {region: FrameErrors(n, *own) for region, n, own in zip(measured, pixels, sums, strict=True)}

    def add(self, frame: Mapping[str, FrameErrors]) -> None:
        """Adds the errors of a frame. Add frames in a fixed order: the sums are then reproducible to the last bit."""
        for region, frames in self._frames.items():
            frames.append(frame[region])

    @property
    def frames(self) -> dict[str, list[FrameErrors]]:
        """The errors of every frame that was added, by region."""
        return self._frames

    def summary(self) -> dict[str, dict[str, Any] | None]:
        """A record per region; None for a region with too few pixels."""
        records: dict[str, dict[str, Any] | None] = {}
        for region, frames in self._frames.items():
            one_by_one = np.cumsum([FrameErrors(0, 0.0, 0.0, 0.0), *frames], axis=0)
            pixels, squared_error, corrected_error, ssim, lpips = one_by_one[-1].tolist()
            records[region] = None
            if pixels < MIN_REGION_PIXELS:
                continue
            pooled = psnr(squared_error / pixels)
            of_frames = [psnr(one.squared_error / one.pixels) for one in frames if one.pixels >= MIN_FRAME_PIXELS]
            known = [value for value in of_frames if value is not None]
            records[region] = {
                "psnr": pooled,
                **({"identical": True} if pooled is None else {}),
                "psnr_frame_mean": float(np.mean(known)) if known else None,
                "psnr_cc": None if pooled is None else psnr(corrected_error / pixels),
                "ssim": ssim / pixels,
                "lpips": lpips / pixels if self._with_lpips else None,
                "pixels": int(pixels),
            }
        return records

    @classmethod
    def of_frames(cls, frames: Mapping[str, Iterable[Sequence[int | float]]], with_lpips: bool) -> "RegionMetrics":
        """Metrics of frames that were measured before, by region; `FrameErrors` or sequences of its fields."""
        found = cls(None, frames)
        found._with_lpips = with_lpips
        found._frames = {region: [FrameErrors(*frame) for frame in own] for region, own in frames.items()}
        return found


def with_gap(regions: dict[str, dict[str, Any] | None]) -> dict[str, Any]:
    """The record of a group of held-out frames: `gap_db`, the PSNR of static minus that of moving vehicles in dB, or of
    all vehicles if none moves, and `human_gap_db`, the same with moving people, None without one of the two; then its
    regions."""
    static, gaps = regions["static"], {}
    dynamic = {"gap_db": regions["moving_vehicle"] or regions["vehicle"], "human_gap_db": regions["moving_human"]}
    for name, moving in dynamic.items():
        known = static and moving and static["psnr"] is not None and moving["psnr"] is not None
        gaps[name] = static["psnr"] - moving["psnr"] if known else None
    return {**gaps, **regions}


def relative_depth_errors(rendered: np.ndarray, known: PixelDepths) -> np.ndarray:
    """|rendered - known| / known of each known depth (n,) in float32, for a rendered depth image (h, w) in metres."""
    found = rendered[known.rows, known.columns].astype(np.float64)
    return (np.abs(found - known.depth) / known.depth).astype(np.float32)


def depth_summary(errors: Sequence[np.ndarray]) -> dict[str, Any]:
    """`depth` of a group of images by the errors of each (`relative_depth_errors`): the median over all `pixels` of the
    group with known depth, None if there are too few; an empty record if no image has known depth."""
    if not errors:
        return {}
    pooled = np.concatenate(errors)
    if len(pooled) < MIN_REGION_PIXELS:
        return {"depth": None}
    return {"depth": {"median_relative_error": float(np.median(pooled)), "pixels": len(pooled)}}
