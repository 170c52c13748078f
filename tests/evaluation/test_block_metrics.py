"""Figures of a drive from those of its blocks: every held-out pixel counts alike."""

from copy import deepcopy
from itertools import pairwise

import numpy as np
import pytest

from drivesplat.errors import ResultError
from drivesplat.evaluation.block_metrics import BlockEvaluation, pooled
from drivesplat.evaluation.metrics import FrameErrors, RegionMetrics
from drivesplat.scene.blocks import Block, Blocks
from drivesplat.scene.regions import REGIONS
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.blocks import PooledJob
from drivesplat.settings.images import HoldoutSettings

HOLDOUT = HoldoutSettings()
RNG = np.random.default_rng(0)


def scene() -> Scene:
    """A drive of 20 key frames."""
    times = np.arange(20) * 500_000
    frames = tuple(
        Frame("front", int(time), "", 16, 9, np.eye(3), np.eye(4), np.eye(4), True, i, str(i))
        for i, time in enumerate(times)
    )
    return Scene("way", "mine", "", "", np.zeros(3), times, frames, (), (), "drive", 2.0)


def cut(count: int = 2) -> Blocks:
    """The drive in blocks of as many key frames each, which overlap by one."""
    ends = np.linspace(0, 20, count + 1).astype(int) * 500_000
    cores = [np.array([pair]) for pair in pairwise(ends)]
    return Blocks("way", tuple(Block(core, core + np.array([-500_000, 500_000]), np.zeros((1, 2))) for core in cores))


def of_drive(blocks: dict[str, BlockEvaluation], left_out: tuple[int, ...] = ()):
    """The figures of the drive from those of its blocks."""
    return pooled(scene(), cut(len(blocks) + len(left_out)), PooledJob(left_out=left_out, holdout=HOLDOUT), blocks)


def frame_errors(pixels: int = 2000) -> FrameErrors:
    return FrameErrors(pixels, *(pixels * RNG.uniform(0.01, 0.05, 2)).tolist(), pixels * RNG.uniform(0.5, 0.9), 0.0)


def evaluation(images: int, **regions: int) -> BlockEvaluation:
    """A block of so many held-out images, with so many pixels of some regions in each."""
    frames = {region: [frame_errors(regions.get(region, 2000)) for _ in range(images)] for region in REGIONS}
    none = {region: [] for region in REGIONS}
    summary = {group: RegionMetrics.of_frames(own, False).summary() for group, own in (("a", frames), ("b", none))}
    result = {
        "interpolation": summary["a"], "extrapolation": summary["b"], "tracks": "annotated", "gaussians": 1000,
        "train_seconds": 2.5, "train_iterations": 100, "peak_gpu_memory_gb": None, "device": "cpu", "random_seed": 0,
        "shown": {"group": "interpolation", "key_frame": 4}, "lpips_unavailable": "lpips.enabled is false",
    }  # fmt: skip
    protocol = {
        "sweeps": False, "width": 16, "visibility": "annotated", "train_images": 7, "held_out_frames": {},
        "key_frame_range": [0, 9], "lidar_missing": 1,
    }  # fmt: skip
    drive = {"interpolation": {"from_training_m": float(images), "luminance": 0.5, "flat_psnr": 10.0}}
    record = {"protocol": protocol, "drive": {**drive, "extrapolation": None}, "result": result, "provenance": {}}
    car = {"id": "car", "class": "car", "category": "car", "images": images, "pixels": 500, "mean_speed": 2.0 * images,
           "moves": images > 2, "psnr": 20.0}  # fmt: skip
    objects = {"groups": {"interpolation": [car], "extrapolation": []}}
    return BlockEvaluation(record, {**objects, "frames": {"interpolation": frames, "extrapolation": none}})


def test_regions_are_pooled_over_the_images_of_all_blocks():
    blocks = {"way.000": evaluation(2), "way.001": evaluation(3)}
    record, objects = of_drive(blocks)
    for region in REGIONS:
        frames = [f for own in blocks.values() for f in own.objects["frames"]["interpolation"][region]]
        pixels = sum(frame.pixels for frame in frames)
        found = record["result"]["interpolation"][region]
        assert found["pixels"] == pixels
        assert found["psnr"] == pytest.approx(-10.0 * np.log10(sum(f.squared_error for f in frames) / pixels))
        assert found["ssim"] == pytest.approx(sum(f.ssim for f in frames) / pixels) and found["lpips"] is None
    assert record["result"]["extrapolation"]["all"] is None
    assert objects["groups"]["interpolation"] == [
        {"id": "car", "class": "car", "category": "car", "images": 5, "pixels": 1000,
         "mean_speed": pytest.approx((2 * 4 + 3 * 6) / 5), "moves": True, "psnr": pytest.approx(20.0)}
    ]  # fmt: skip


def test_regions_that_are_small_in_each_block_count_in_the_drive():
    blocks = {f"way.00{i}": evaluation(1, moving_vehicle=600) for i in range(2)}
    assert all(own.record["result"]["interpolation"]["moving_vehicle"] is None for own in blocks.values())
    found = of_drive(blocks)[0]["result"]["interpolation"]["moving_vehicle"]
    assert found["pixels"] == 1200


def test_the_protocol_is_that_of_the_drive_and_costs_are_summed():
    record, _ = of_drive({"way.000": evaluation(1), "way.001": evaluation(3)})
    assert record["scene"] == "way" and record["protocol"]["held_out_frames"]["interpolation"] == [4, 12]
    assert (record["protocol"]["train_images"], record["protocol"]["key_frame_range"]) == (14, None)
    assert record["protocol"]["lidar_missing"] == 2
    result = record["result"]
    assert (result["gaussians"], result["train_seconds"], result["train_iterations"]) == (2000, 5.0, 200)
    assert result["blocks"].keys() == {"way.000", "way.001"} and result["peak_gpu_memory_gb"] is None
    assert record["drive"]["interpolation"]["from_training_m"] == pytest.approx((1 * 1 + 3 * 3) / 4)
    assert record["drive"]["extrapolation"] is None


def test_blocks_that_were_measured_differently_are_refused():
    first, other = evaluation(1), evaluation(1)
    changed = deepcopy(other.record)
    changed["protocol"]["sweeps"] = True
    with pytest.raises(ResultError, match=r"blocks way.000 and way.001 were measured differently \(sweeps\)"):
        of_drive({"way.000": first, "way.001": BlockEvaluation(changed, other.objects)})


def test_blocks_may_lack_tracks_and_held_out_images():
    empty, full = evaluation(0), evaluation(2)
    empty.record["protocol"] |= {"visibility": None, "width": 99}
    record, _ = of_drive({"way.000": empty, "way.001": full})
    assert (record["protocol"]["visibility"], record["protocol"]["width"]) == ("annotated", 16)


def test_blocks_that_are_left_out_are_named_and_their_images_are_not_counted():
    record, _ = of_drive({"way.000": evaluation(1), "way.002": evaluation(3)}, left_out=(1,))
    assert record["protocol"]["left_out"] == ["way.001"] and record["result"]["blocks"].keys() == {"way.000", "way.002"}
    whole = of_drive({f"way.00{i}": evaluation(1) for i in range(3)})[0]["protocol"]
    assert whole["left_out"] == [] and whole["held_out_frames"] == HOLDOUT.held_out(20)
    first, last = cut(3).blocks[1].core[0] // 500_000
    kept = {group: [i for i in own if not first <= i < last] for group, own in whole["held_out_frames"].items()}
    assert record["protocol"]["held_out_frames"] == kept != whole["held_out_frames"]
    held_out = {i for own in whole["held_out_frames"].values() for i in own}
    of_neighbours = {first, last - 1} - held_out
    assert record["protocol"]["train_images"] == sum(
        i in of_neighbours or not (first <= i < last or i in held_out) for i in range(20)
    )
