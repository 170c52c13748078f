"""Expected PSNR, range error and validity of images and LiDAR scans from off the recorded path, compared with the truth
of a synthetic world.

    python -m benchmarks.view_validity results/demo/street resources/demo
    python -m benchmarks.view_validity results/demo/street_lidar resources/demo --only scans

Takes the key frames of the evaluated camera: from the recorded path, from beside it as far as the world has truth, and
turned by 20 degrees to either side, for which it renders the truth. Prints a row for each kind of view, and last the
median absolute error of the expected PSNR, the rank correlation of validity and of expected PSNR with the true PSNR,
the share of views within the interval, and the time of a validity beside that of its image: over all views, and over
those that are no training images.

Then, for a method that renders LiDAR, the same of the expected range error: of scans at all key frames, from the
recorded path and from up to 4 m beside it, compared with what the world's LiDAR measures there, sensor noise included.
The figures stand in docs/closed_loop.md.
"""

import json
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr

import drivesplat
from benchmarks.command import argument_parser, run_command
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.evaluation.synthetic import DriveTruth
from drivesplat.io.storage import read_json
from drivesplat.model.view import View
from drivesplat.readers.truth import TRUTH_FILE
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.images import read_image
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scan import ScanRays, wrapped
from drivesplat.settings.world import WorldSettings
from drivesplat.simulate.scan_validity import ScanKnowledge, ScanValidity
from drivesplat.simulate.seen_from import recorded_image
from drivesplat.simulate.validity import ViewKnowledge, ViewValidity
from drivesplat.world.optics.imaging import render, to_bytes
from drivesplat.world.optics.rig import SENSORS, key_frame_time
from drivesplat.world.recorder import RECORDED, Recorder, Viewpoint

YAWS = (-20.0, 20.0)
"""Turns of the camera to the left, degrees."""


LEFT_M = (0.0, 1.0, -1.0, 2.0, -2.0, 3.0, 4.0)
"""Metres to the left of the recorded path of scans. Parked cars stand farther to the right."""


def recorder_of(world: Path) -> Recorder:
    """What records the world of a folder."""
    made = read_json(world / "world.json", "demo_world")["provenance"]["stages"]["demo_world"]["settings"]
    return Recorder(WorldSettings.model_validate(made["world"]), made["scene"])


class TrueViews:
    """Views of a drive with true images (h, w, 3) in [0, 1]."""

    def __init__(self, drive: TrainedDrive, world: Path):
        self._drive = drive
        self._truth = DriveTruth.read(world / TRUTH_FILE, EvaluationData(drive.scene, drive.record, None))
        self._recorder = recorder_of(world)

    def __iter__(self) -> Iterator[tuple[str, View, np.ndarray]]:
        record, device, known = self._drive.record, self._drive.device, self._truth
        camera = record.camera_name(0)
        for index in np.flatnonzero(record.is_key_frame & (record.camera_indices == record.camera_indices[0])).tolist():
            view = known.view(index, known.recording.frame(index), device)
            yield (
                "path",
                view,
                read_image(recorded_image(record, self._drive.folder, index), record.image_size(index)) / 255.0,
            )
            for yaw in YAWS:
                turn = rigid(Rotation.from_euler("y", -yaw, degrees=True).as_matrix(), np.zeros(3))
                pose = view.camera_to_world @ torch.from_numpy(turn).float().to(device)
                image = self._turned(camera, int(record.sample_indices[index]), turn)
                yield f"turned {yaw:+g} degrees", replace(view, camera_to_world=pose), image
        for beside in known.truth.lateral(camera):
            for index, frame, truth in known.lateral_frames(beside):
                assert truth.image is not None
                image = known.image(truth.image, record.image_size(index))
                yield f"{beside.left_m:+g} m to the left", known.view(index, frame, device), image

    def _turned(self, camera: str, key_frame: int, turn: np.ndarray) -> np.ndarray:
        """The true image of a key frame if the camera is turned (4, 4)."""
        made, sensor = self._recorder, next(sensor for sensor in SENSORS if sensor.channel == camera)
        seconds = (key_frame_time(made.world, key_frame) + sensor.delay_us) * 1e-6
        placed = made.camera(sensor, seconds)
        placed = replace(placed, camera_to_street=placed.camera_to_street @ turn)
        snapshot = made.snapshot(placed.seconds, RECORDED)
        return to_bytes(render(snapshot, made.light(seconds), placed, made.world.samples_per_pixel).radiance) / 255.0


@dataclass(frozen=True)
class TrueScan:
    """A scan `left_m` metres to the left of a recorded one: the LiDAR with its rays, the keywords that place it at the
    `seconds` of the recorded scan, the `ranges` (b, a) that it measures in the world, metres, and which rays
    `returned`; `is_training`: whether it is a training scan's, from its own place."""

    left_m: float
    seconds: float
    is_training: bool
    lidar: drivesplat.Lidar
    placed: dict[str, Any]
    ranges: np.ndarray
    returned: np.ndarray


def true_scans(drive: TrainedDrive, recorder: Recorder) -> Iterator[TrueScan]:
    """The scans of all key frames from LEFT_M, as the world's LiDAR measures them."""
    sensor, pattern = next(sensor for sensor in SENSORS if not sensor.is_camera), recorder.pattern
    around = wrapped(0.5 * np.pi - pattern.azimuths)  # the pattern's count clockwise from y, the sensor's from x to y
    order = np.argsort(around, kind="stable")
    grids = (around[order], pattern.elevations[:, None], pattern.offsets[order])
    rays = ScanRays(*(np.broadcast_to(values, pattern.shape).astype(np.float32) for values in grids))
    for left in LEFT_M:
        for scan in drive.recording.scans.scans:
            if not scan.is_key_frame:
                continue
            time, view = key_frame_time(recorder.world, scan.sample_index) + sensor.delay_us, Viewpoint(left=left)
            found = recorder.scan(sensor, time, view)
            at = np.array([time * 1e-6])
            poses = [recorder.ego_to_street(at, own)[0] @ sensor.sensor_to_ego for own in (RECORDED, view)]
            pose = scan.sensor_to_world @ inverse(poses[0]) @ poses[1]
            placed = {"sensor_to_world": pose, "velocity": np.concatenate([scan.linear, scan.angular])}
            yield TrueScan(
                left, scan.seconds, not left and scan.group == "train", drivesplat.Lidar(rays), placed,
                found.measured[:, order], found.returned[:, order],
            )  # fmt: skip


def measured_scans(drive: TrainedDrive, known: ScanKnowledge, scans: Iterable[TrueScan]) -> list[dict]:
    """A row for each scan that has returns: its true median range error, and what is expected of it."""
    rows = []
    for true in scans:
        world = drive.state(true.seconds, outside="clamp")
        begin = time.perf_counter()
        scan = world.scan(true.lidar, **true.placed, with_instance=False)
        rendered = time.perf_counter()
        found, took = known.validity(world, scan), time.perf_counter() - rendered
        both = scan.returned.cpu().numpy() & true.returned
        if both.any() and found.expected_range_error is not None:
            error = float(np.median(np.abs(scan.range.cpu().numpy() - true.ranges)[both]))
            timing = {"seconds": took, "share": took / (rendered - begin)}
            rows.append(
                {"left_m": true.left_m, "is_training": true.is_training, "error": error, "found": found, **timing}
            )
    return rows


def scan_summary(rows: Sequence[dict]) -> dict[str, float]:
    """The figures of all scans."""
    found: list[ScanValidity] = [row["found"] for row in rows]
    true, expected = np.array([row["error"] for row in rows]), np.array([one.expected_range_error for one in found])
    low, high = np.array([one.interval for one in found]).T
    low_q, high_q = np.quantile(true / expected, [0.05, 0.95])
    return {
        "scans": len(rows),
        "median_absolute_error_mm": float(1e3 * np.median(np.abs(expected - true))),
        "90_percent_below_mm": float(1e3 * np.quantile(np.abs(expected - true), 0.9)),
        "median_true_mm": float(1e3 * np.median(true)),
        "mean_expected_by_true": float(np.mean(expected / true)),
        "true_by_expected_5_percent": float(low_q),
        "true_by_expected_95_percent": float(high_q),
        "rank_correlation_of_validity": float(-spearmanr([one.validity for one in found], true)[0]),
        "rank_correlation_of_expected_error": float(spearmanr(expected, true)[0]),
        "share_within_interval": float(np.mean((low <= true) & (true <= high))),
        "median_seconds": float(np.median([row["seconds"] for row in rows])),
        "median_share_of_rendering": float(np.median([row["share"] for row in rows])),
    }


def print_scans(drive: TrainedDrive, world: Path) -> None:
    """Prints the figures of scans."""
    known = ScanKnowledge.of_drive(drive)
    print(
        f"scans: error {1e3 * known.error:.1f} mm, growth {known.growth:.2f}, reference {1e3 * known.reference:.1f} mm"
    )
    rows = measured_scans(drive, known, true_scans(drive, recorder_of(world)))
    for left in LEFT_M:
        own = [row for row in rows if row["left_m"] == left]
        errors = {"true": [row["error"] for row in own], "expected": [row["found"].expected_range_error for row in own]}
        shares = ("validity", "supported", "unseen")
        means = [f"{name} {1e3 * np.mean(values):.1f} mm" for name, values in errors.items()]
        means += [f"{name} {np.mean([getattr(row['found'], name) for row in own]):.3f}" for name in shares]
        print(f"{left:+g} m to the left".ljust(24), *means)
    new = [row for row in rows if not row["is_training"]]
    beside = [row for row in rows if row["left_m"]]
    groups = {"all scans": rows, "without training scans": new, "beside the path": beside}
    print(json.dumps({name: scan_summary(own) for name, own in groups.items()}, indent=1))


def measured(drive: TrainedDrive, known: ViewKnowledge, views: TrueViews) -> list[dict]:
    """A row for each view."""
    rows = []
    for kind, view, image in views:
        world = drive.state(view.time, outside="clamp")
        with torch.no_grad():
            begin = time.perf_counter()
            shown = world.placed().render(view).image.clamp(0.0, 1.0).double().cpu().numpy()
            rendered = time.perf_counter()
            found = known.validity(world, view)
        took = time.perf_counter() - rendered
        psnr = float(-10.0 * np.log10(np.mean((shown - image) ** 2)))
        rows.append({"kind": kind, "psnr": psnr, "found": found, "share": took / (rendered - begin), "seconds": took})
    return rows


def summary(rows: Sequence[dict]) -> dict[str, float]:
    """The figures of all views."""
    found: list[ViewValidity] = [row["found"] for row in rows]
    true = np.array([row["psnr"] for row in rows])
    expected = np.array([one.expected_psnr for one in found], dtype=float)
    low, high = np.array([one.interval for one in found], dtype=float).T
    return {
        "views": len(rows),
        "median_absolute_error_db": float(np.median(np.abs(expected - true))),
        "90_percent_below_db": float(np.quantile(np.abs(expected - true), 0.9)),
        "bias_db": float(np.mean(expected - true)),
        "rank_correlation_of_validity": float(spearmanr([one.validity for one in found], true)[0]),
        "rank_correlation_of_expected_psnr": float(spearmanr(expected, true)[0]),
        "share_within_interval": float(np.mean((low <= true) & (true <= high))),
        "median_seconds": float(np.median([row["seconds"] for row in rows])),
        "median_share_of_rendering": float(np.median([row["share"] for row in rows])),
    }


def print_images(drive: TrainedDrive, world: Path) -> None:
    """Prints the figures of images."""
    known = ViewKnowledge.of_drive(drive)
    rows = measured(drive, known, TrueViews(drive, world))
    print(f"growth {known.errors.growth:.2f}")
    for kind in dict.fromkeys(row["kind"] for row in rows):
        own = [row for row in rows if row["kind"] == kind]
        values = {"true": [row["psnr"] for row in own], "expected": [row["found"].expected_psnr for row in own]}
        values |= {name: [getattr(row["found"], name) for row in own] for name in ("validity", "supported", "unseen")}
        print(f"{kind:24}", *(f"{name} {np.mean(of_views):.3f}" for name, of_views in values.items()))
    new = [row for row in rows if row["found"].distance > 0.0 or row["found"].angle > 0.1]
    print(json.dumps({"all views": summary(rows), "without training images": summary(new)}, indent=1))


def main(arguments: Sequence[str]) -> int:
    """Prints the figures of a drive."""
    parser = argument_parser("view_validity", __doc__)
    parser.add_argument("folder", type=Path, help="the result folder of a method")
    parser.add_argument("world", type=Path, help="the folder of the synthetic world, with truth/truth.json")
    parser.add_argument("--device", default="any", help="any, cuda or cpu")
    parser.add_argument(
        "--only", choices=("images", "scans"), help="the sensor whose figures are printed; default: both"
    )
    given = parser.parse_args(arguments)
    drive = drivesplat.open(given.folder, device=given.device)
    if given.only != "scans":
        print_images(drive, given.world)
    if given.only == "scans" or (given.only is None and drive.renders_lidar):
        print_scans(drive, given.world)
    return 0


if __name__ == "__main__":
    run_command(main)
