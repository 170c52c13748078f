"""The stage `evaluate_blocks`: the measurements of the blocks of a long drive as those of the drive."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.errors import ResultError
from drivesplat.evaluation.eval_record import summarize_swept_drive
from drivesplat.evaluation.evaluate import findings
from drivesplat.evaluation.metrics import MIN_FRAME_PIXELS, RegionMetrics, psnr, with_gap
from drivesplat.io.storage import Provenance, read_record
from drivesplat.scene.blocks import Blocks, within
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import HELD_OUT_GROUPS, held_out_key_frames, training_images
from drivesplat.settings.blocks import PooledJob

COMPARED = ("version", "cameras", "eval_camera", "sweeps", "holdout", "poses", "regions", "extra_points")
"""Of a protocol, what follows from settings: it is the same in all blocks of a drive."""


@dataclass(frozen=True)
class BlockEvaluation:
    """The contents of a block's eval.json and eval_objects.json."""

    record: dict[str, Any]
    objects: dict[str, Any]

    @classmethod
    def read(cls, path: str | Path) -> "BlockEvaluation":
        """Reads eval.json and the file beside it. Raises ResultError if one is invalid."""
        record = read_record(path, "evaluate", "protocol", "drive", "result", "provenance")
        objects = read_record(Path(path).with_name("eval_objects.json"), "evaluate", "groups", "frames", "provenance")
        return cls(record, objects)

    @property
    def provenance(self) -> Provenance:
        """That of both files."""
        return self.record["provenance"]


def pooled(
    scene: Scene, blocks: Blocks, job: PooledJob, measured: Mapping[str, BlockEvaluation]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The contents of the eval.json and the eval_objects.json of a drive, without provenance, from the measurements of
    its blocks that are not left out, by name. Pixels of all these blocks count alike. Truth, LiDAR scans and LiDAR
    depth are those of blocks alone.

    Raises ResultError where blocks were measured differently.
    """
    first, *others = measured.values()
    for name, other in zip(list(measured)[1:], others, strict=True):
        for key in COMPARED:
            if other.record["protocol"].get(key) != first.record["protocol"].get(key):
                raise ResultError(
                    f"blocks {next(iter(measured))} and {name} were measured differently ({key}); delete the older "
                    "eval.json and rerun"
                )
    every, header = list(measured.values()), {"schema": 1, "scene": scene.name, "dataset": scene.dataset}
    groups = {group: _pooled_group(every, group) for group in HELD_OUT_GROUPS}
    objects = {group: _pooled_objects(every, group) for group in HELD_OUT_GROUPS}
    shown = next(iter(measured))
    result = {
        **groups,
        "tracks": first.record["result"]["tracks"],
        **_pooled_training(every),
        "findings": findings(groups["interpolation"]),
        "shown": {**first.record["result"]["shown"], "block": shown},
        "blocks": {name: _of_block(own) for name, own in measured.items()},
    }
    if "lpips_unavailable" in first.record["result"]:
        result["lpips_unavailable"] = first.record["result"]["lpips_unavailable"]
    with_images = next((own for own in every if _frames([own], "interpolation").get("all")), first)
    seen = [own.record["protocol"].get("visibility") for own in every]
    protocol = {
        **with_images.record["protocol"],
        "visibility": next((kind for kind in ("estimated", "annotated") if kind in seen), None),
        "images_missing": scene.missing_images,
        "held_out_frames": _held_out(scene, blocks, job),
        "train_images": _training_images(scene, blocks, job),
        "left_out": [blocks.names[number] for number in job.left_out],
        "key_frame_range": scene.key_frame_range,
        "lidar_missing": sum(own.record["protocol"]["lidar_missing"] for own in every),
    }
    if "nearest_training_s" in protocol:
        apart = [own.record["protocol"]["nearest_training_s"] for own in every]
        protocol["nearest_training_s"] = min((value for value in apart if value is not None), default=None)
    drive = {**summarize_swept_drive(scene), **{group: _pooled_drive(every, group) for group in HELD_OUT_GROUPS}}
    record = {**header, "protocol": protocol, "drive": drive, "result": result}
    return record, {**header, "groups": objects}


def _held_out(scene: Scene, blocks: Blocks, job: PooledJob) -> dict[str, list[int]]:
    """The held-out key frames of a drive by group, without those of blocks that are left out."""
    stamps = scene.key_frame_timestamps.tolist()
    every = held_out_key_frames(scene, job.holdout).items()
    return {group: [i for i in indices if blocks.at(stamps[i]) not in job.left_out] for group, indices in every}


def _training_images(scene: Scene, blocks: Blocks, job: PooledJob) -> int:
    """The number of the training images of a drive, without those that only blocks which are left out have."""
    stamps = [scene.frames[i].timestamp for i in training_images(scene, job.holdout)]
    used = np.concatenate([blocks.blocks[number].used for number in blocks.without(job.left_out)])
    return int(within(np.array(stamps, dtype=np.int64), used).sum())


def _frames(blocks: Sequence[BlockEvaluation], group: str) -> dict[str, list[Sequence[int | float]]]:
    """The errors of the images of a group by region, over all blocks."""
    found: dict[str, list[Sequence[int | float]]] = {}
    for block in blocks:
        for region, frames in block.objects["frames"][group].items():
            found.setdefault(region, []).extend(frames)
    return found


def _pooled_group(blocks: Sequence[BlockEvaluation], group: str) -> dict[str, Any]:
    everywhere = (block.record["result"][group]["all"] for block in blocks)
    with_lpips = any(found is not None and found["lpips"] is not None for found in everywhere)
    return with_gap(RegionMetrics.of_frames(_frames(blocks, group), with_lpips).summary())


def _pooled_objects(blocks: Sequence[BlockEvaluation], group: str) -> list[dict[str, Any]]:
    """The records of objects, of which one may have been seen in several blocks."""
    of_track: dict[str, list[dict[str, Any]]] = {}
    for block in blocks:
        for item in block.objects["groups"][group]:
            of_track.setdefault(item["id"], []).append(item)
    records = []
    for items in of_track.values():
        images, known = [item["images"] for item in items], [item for item in items if item["psnr"] is not None]
        pixels = sum(item["pixels"] for item in known)
        error = sum(item["pixels"] * 10.0 ** (-item["psnr"] / 10.0) for item in known)
        records.append(
            {
                **items[0],
                "images": sum(images),
                "pixels": sum(item["pixels"] for item in items),
                "mean_speed": float(np.average([item["mean_speed"] for item in items], weights=images)),
                "moves": any(item["moves"] for item in items),
                "psnr": psnr(error / pixels) if pixels >= MIN_FRAME_PIXELS else None,
            }
        )
    return sorted(records, key=lambda record: (-record["pixels"], record["id"]))


def _pooled_training(blocks: Sequence[BlockEvaluation]) -> dict[str, Any]:
    """The figures of the trainings: sums, and the largest memory of any."""
    results = [block.record["result"] for block in blocks]
    memory = [own["peak_gpu_memory_gb"] for own in results]
    return {
        **{name: sum(own[name] for own in results) for name in ("gaussians", "train_seconds", "train_iterations")},
        "peak_gpu_memory_gb": max((value for value in memory if value is not None), default=None),
        "device": ", ".join(sorted({own["device"] for own in results})),
        "random_seed": results[0]["random_seed"],
    }


def _pooled_drive(blocks: Sequence[BlockEvaluation], group: str) -> dict[str, Any] | None:
    """Means over the images of all blocks; the trivial baseline has one colour in each block."""
    of_images = [(block.record["drive"][group], _frames([block], group)) for block in blocks]
    known = [(drive, frames) for drive, frames in of_images if drive is not None]
    if not known:
        return None
    images = [len(frames["all"]) for _, frames in known]
    static = [sum(frame[0] for frame in frames["static"]) for _, frames in known]
    flat = [
        (count, 10.0 ** (-drive["flat_psnr"] / 10.0))
        for count, (drive, _) in zip(static, known, strict=True)
        if count and drive["flat_psnr"] is not None
    ]
    trained = [(n, drive["from_training_m"]) for n, (drive, _) in zip(images, known, strict=True)]
    apart = [(n, metres) for n, metres in trained if metres is not None]
    return {
        "from_training_m": sum(n * metres for n, metres in apart) / sum(n for n, _ in apart) if apart else None,
        "luminance": float(np.average([drive["luminance"] for drive, _ in known], weights=images)),
        "flat_psnr": psnr(sum(n * error for n, error in flat) / sum(n for n, _ in flat)) if flat else None,
    }


def _of_block(block: BlockEvaluation) -> dict[str, Any]:
    """What the record of the drive says of a block: the PSNR of static and moving pixels, and its Gaussians."""
    result, found = block.record["result"], {}
    for group in HELD_OUT_GROUPS:
        regions = {name: result[group].get(name) for name in ("static", "moving_vehicle")}
        found[group] = {name: own and own["psnr"] for name, own in regions.items()}
    return {**found, "gaussians": result["gaussians"], "train_seconds": result["train_seconds"]}
