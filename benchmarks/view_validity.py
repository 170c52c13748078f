"""Expected PSNR and validity of images from off the recorded path, compared with the truth of a synthetic world.

    python -m benchmarks.view_validity results/demo/street resources/demo

Takes the key frames of the evaluated camera: from the recorded path, from beside it as far as the world has truth, and
turned by 20 degrees to either side, for which it renders the truth. Prints a row for each kind of view, and last the
median absolute error of the expected PSNR, the rank correlation of validity and of expected PSNR with the true PSNR,
the share of views within the interval, and the time of a validity beside that of its image: over all views, and over
those that are no training images. The figures stand in docs/closed_loop.md.
"""

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

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
from drivesplat.scene.rigid import rigid
from drivesplat.settings.world import WorldSettings
from drivesplat.simulate.seen_from import recorded_image
from drivesplat.simulate.validity import ViewKnowledge, ViewValidity
from drivesplat.world.optics.imaging import render, to_bytes
from drivesplat.world.optics.rig import SENSORS, key_frame_time
from drivesplat.world.recorder import RECORDED, Recorder

YAWS = (-20.0, 20.0)
"""Turns of the camera to the left, degrees."""


class TrueViews:
    """Views of a drive with true images (h, w, 3) in [0, 1]."""

    def __init__(self, drive: TrainedDrive, world: Path):
        self._drive = drive
        self._truth = DriveTruth.read(world / TRUTH_FILE, EvaluationData(drive.scene, drive.record, None))
        made = read_json(world / "world.json", "demo_world")["provenance"]["stages"]["demo_world"]["settings"]
        self._recorder = Recorder(WorldSettings.model_validate(made["world"]), made["scene"])

    def __iter__(self) -> Iterator[tuple[str, View, np.ndarray]]:
        record, device, known = self._drive.record, self._drive.device, self._truth
        camera = record.camera_name(0)
        for index in np.flatnonzero(record.is_key_frame & (record.camera_indices == record.camera_indices[0])).tolist():
            view = known.view(index, known.recording.frame(index), device)
            yield "path", view, read_image(recorded_image(self._drive, index), record.image_size(index)) / 255.0
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


def main(arguments: Sequence[str]) -> int:
    """Prints the figures of a drive."""
    parser = argument_parser("view_validity", __doc__)
    parser.add_argument("folder", type=Path, help="the result folder of a method")
    parser.add_argument("world", type=Path, help="the folder of the synthetic world, with truth/truth.json")
    parser.add_argument("--device", default="any", help="any, cuda or cpu")
    given = parser.parse_args(arguments)
    drive = drivesplat.open(given.folder, device=given.device)
    known = ViewKnowledge.of_drive(drive)
    rows = measured(drive, known, TrueViews(drive, given.world))
    print(f"growth {known.errors.growth:.2f}")
    for kind in dict.fromkeys(row["kind"] for row in rows):
        own = [row for row in rows if row["kind"] == kind]
        values = {"true": [row["psnr"] for row in own], "expected": [row["found"].expected_psnr for row in own]}
        values |= {name: [getattr(row["found"], name) for row in own] for name in ("validity", "supported", "unseen")}
        print(f"{kind:24}", *(f"{name} {np.mean(of_views):.3f}" for name, of_views in values.items()))
    new = [row for row in rows if row["found"].distance > 0.0 or row["found"].angle > 0.1]
    print(json.dumps({"all views": summary(rows), "without training images": summary(new)}, indent=1))
    return 0


if __name__ == "__main__":
    run_command(main)
