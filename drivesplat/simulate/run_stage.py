"""The stage `run`: a policy drives in a trained drive, into figures, and a film of what the camera sees and of the
street from above."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from drivesplat.drive.cameras import PoseableCamera
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.errors import RequestError
from drivesplat.io.video import write_video
from drivesplat.settings.simulate import RunJob
from drivesplat.simulate.episodes import Episode, driven_episode
from drivesplat.simulate.policies import Policy, policy_of, settings_for
from drivesplat.simulate.scan_validity import ScanValidity
from drivesplat.simulate.scores import run_scores
from drivesplat.simulate.simulation import Simulation
from drivesplat.simulate.trust import Trust
from drivesplat.simulate.validity import ViewValidity

BELIEVABLE = 0.5
"""The validity below which an image or a scan is not believed: 6 dB worse than held-out images, twice the range error
of held-out scans, or half of it never seen."""
METRES_AHEAD, METRES_BEHIND = 45.0, 15.0
"""What the view from above shows along the heading of the ego vehicle."""
GROUND, PATH, EGO, OTHER, TOUCHED = (38, 40, 44), (90, 150, 230), (80, 200, 120), (190, 190, 195), (235, 80, 70)
"""Colours."""


def drive_runs(drive: TrainedDrive, job: RunJob, film: Path) -> dict[str, Any]:
    """Drives the episodes of a run, of each seed one, and writes the film of the first. Returns the content of the
    run's record without provenance; its `failed` says what is wrong with a policy that cannot be made, or that fails.

    Raises RequestError and ConfigError where the drive does not fit the settings.
    """
    edited = drive if job.edit is None else drive.edited(job.edit)
    run = job.run
    try:
        policy: Policy | None = policy_of(run.policy, run.policy_settings)
        refused = None
    except RequestError as error:
        policy, refused = None, str(error)
    simulation = Simulation(edited, settings_for(run.simulation, policy))
    pictures = RunFilm(simulation, run.film_width)
    trust = Trust(edited)
    trust.inform(simulation)
    rate = max(1, round(run.simulation.rate_hz))
    driven: list[_Driven] = []
    if policy is None:
        write_video(film, [pictures.frame(simulation, "no policy")], pictures.size, rate, job.crf)
    else:
        for number, seed in enumerate(run.seeds):  # a policy of its own for each: one that hangs keeps its thread
            own = policy if number == 0 else policy_of(run.policy, run.policy_settings)
            driven.append(_Driven(simulation, own, seed, run.timeout_s, pictures, trust, filmed=number == 0))
        write_video(film, driven[0].frames, pictures.size, rate, job.crf)
    failures = (own.episode.failed for own in driven)
    return {
        "schema": 1,
        "run": run.model_dump(mode="json"),
        "edit": None if job.edit is None else job.edit.model_dump(mode="json"),
        "failed": refused or next(filter(None, failures), None),
        "episodes": [own.figures() for own in driven],
    }


class RunFilm:
    """Frames of a film: the image of a camera beside the street from above, and lines of text below."""

    def __init__(self, simulation: Simulation, width: int):
        drive = simulation.drive
        self.camera: PoseableCamera | None = None
        height = 2 * round(width * 9 / 32)
        if drive.cameras:
            camera = drive.camera(next(iter(simulation.cameras), drive.cameras[0]))
            self.camera = camera.resized(width - width % 2)
            height = self.camera.height + self.camera.height % 2
        self._height = height
        self._scale = height / (METRES_AHEAD + METRES_BEHIND)
        self._above = 2 * (height // 3)
        self._text = 2 * max(12, round(0.03 * height))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        beside = 0 if self.camera is None else self.camera.width
        return beside + self._above, self._height + self._text

    def frame(
        self, simulation: Simulation, note: str = "", validity: float | None = None
    ) -> UInt8[np.ndarray, "h w 3"]:
        """The frame of a run as it now is, with a `note` and a bar of the image's `validity` (0 to 1; None: no bar)."""
        width, height = self.size
        frame = np.zeros((height, width, 3), dtype=np.uint8)
        frame[: self._height, width - self._above :] = self._from_above(simulation)
        if self.camera is not None:
            image = simulation.world().render(self.camera, **simulation.place).image
            frame[: self.camera.height, : self.camera.width] = image
            if validity is not None:
                self._bar(frame, validity)
        ego = simulation.ego
        text = f"{simulation.time:.1f} s   {3.6 * ego.speed:.0f} km/h   {simulation.offset:.1f} m from the path"
        size = 0.5 * self._text / 24.0
        for words, line in ((text, 1), (note, 2)):
            place = (self._text // 4, self._height + line * self._text // 2 - self._text // 10)
            cv2.putText(frame, words, place, cv2.FONT_HERSHEY_SIMPLEX, size, (235, 235, 235), 1, cv2.LINE_AA)
        return frame

    def _bar(self, frame: np.ndarray, validity: float) -> None:
        """A bar at the lower edge of the camera's image: green where it can be trusted, red where not."""
        assert self.camera is not None
        thick, wide = max(3, self._height // 60), round(self.camera.width * min(max(validity, 0.0), 1.0))
        color = (round(230 * (1.0 - validity)), round(200 * validity), 60)
        frame[self.camera.height - thick : self.camera.height, : self.camera.width] //= 3
        frame[self.camera.height - thick : self.camera.height, :wide] = color

    def _from_above(self, simulation: Simulation) -> UInt8[np.ndarray, "h w 3"]:
        """The street from above, the heading of the ego vehicle upwards."""
        picture = np.full((self._height, self._above, 3), GROUND, dtype=np.uint8)
        route = np.concatenate([np.zeros((1, 2)), simulation.route()[:, :2]]).astype(np.float64)
        cv2.polylines(picture, [self._pixels(route)], False, PATH, max(1, self._height // 200), cv2.LINE_AA)
        touched, shape = set(simulation.contacts()), simulation.settings.vehicle
        ids, boxes = simulation.boxes()
        for id, (x, y, _, length, width, _, yaw, _) in zip(ids, boxes.tolist(), strict=True):
            self._box(picture, x, y, yaw, length, width, TOUCHED if id in touched else OTHER)
        self._box(picture, 0.5 * shape.length - shape.rear_overhang, 0.0, 0.0, shape.length, shape.width, EGO)
        return picture

    def _box(
        self, picture: np.ndarray, x: float, y: float, yaw: float, length: float, width: float, color: Sequence[int]
    ) -> None:
        forward, left = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
        signs = np.array([(1, 1), (1, -1), (-1, -1), (-1, 1)])
        corners = np.array([x, y]) + 0.5 * signs[:, :1] * length * forward + 0.5 * signs[:, 1:] * width * left
        cv2.fillPoly(picture, [self._pixels(corners)], tuple(color), cv2.LINE_AA)
        nose = np.array([[x, y], [x, y] + 0.5 * length * forward])
        cv2.polylines(picture, [self._pixels(nose)], False, GROUND, 1, cv2.LINE_AA)

    def _pixels(self, places: Float64[np.ndarray, "k 2"]) -> np.ndarray:
        """Places in the frame of the ego vehicle, x upwards in the picture."""
        across = 0.5 * self._above - self._scale * places[:, 1]
        down = self._scale * (METRES_AHEAD - places[:, 0])
        return np.stack([across, down], axis=1).clip(-1e5, 1e5).round().astype(np.int32)


class _Driven:
    """An episode with the validity of its images and scans, and with `frames` of its film if it is `filmed`."""

    def __init__(
        self,
        simulation: Simulation,
        policy: Policy,
        seed: int,
        timeout_s: float,
        pictures: RunFilm,
        trust: Trust,
        filmed: bool,
    ):
        self.frames: list[np.ndarray] = []
        self._views: list[ViewValidity] = []
        self._scans: list[ScanValidity] = []

        def look(now: Simulation) -> None:
            own, scan = None if pictures.camera is None else trust.image(now, pictures.camera), trust.scan(now)
            self._views += [] if own is None else [own]
            self._scans += [] if scan is None else [scan]
            if filmed:
                touched = now.contacts()
                note = f"contact with {', '.join(touched)}" if touched else ""
                self.frames.append(pictures.frame(now, note, None if own is None else own.validity))

        self.episode: Episode = driven_episode(simulation, policy, seed, timeout_s, look)
        if filmed and not self.frames:  # it failed before the first step
            self.frames.append(pictures.frame(simulation, "a failed policy"))

    def figures(self) -> dict[str, Any]:
        """The episode as plain data: its scores, the path of the ego vehicle, how far its images and scans can be
        trusted, and the seconds up to which all of them can (None: to the end)."""
        run, views, scans = self.episode.run, self._views, self._scans
        headings = np.arctan2(run.ego_to_world[:, 1, 0], run.ego_to_world[:, 0, 0])
        path = np.column_stack([run.seconds, run.ego_to_world[:, :3, 3], headings, run.speed, run.steering])
        doubtful = [i for own in (views, scans) for i, one in enumerate(own) if one.validity < BELIEVABLE]
        expected, errors = [view.expected_psnr for view in views], [scan.expected_range_error for scan in scans]
        return {
            "seed": self.episode.seed,
            "ended": self.episode.ended,
            "failed": self.episode.failed,
            "scores": run_scores(run).summary,
            "believable_s": float(run.seconds[min(doubtful)] - run.seconds[0]) if doubtful else None,
            "validity": [round(view.validity, 3) for view in views],
            "expected_psnr": [None if value is None else round(value, 2) for value in expected],
            "scan_validity": [round(scan.validity, 3) for scan in scans],
            "expected_range_error": [None if value is None else round(value, 4) for value in errors],
            "path_columns": ["seconds", "x", "y", "z", "yaw", "speed", "steering"],
            "path": np.round(path, 4).tolist(),
        }
