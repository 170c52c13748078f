"""The stage `run`: a policy drives in a trained drive, into figures and a film."""

from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.errors import RequestError
from drivesplat.io.video import write_video
from drivesplat.settings.simulate import RunJob, SimulationSettings
from drivesplat.simulate.episodes import Episode, driven_episode
from drivesplat.simulate.policies import Policy, policy_of
from drivesplat.simulate.run_film import RunFilm
from drivesplat.simulate.scores import run_scores
from drivesplat.simulate.simulation import Simulation
from drivesplat.simulate.validity import ViewValidity

BELIEVABLE = 0.5
"""The validity below which an image is not believed: 6 dB worse than held-out images, or half of it never seen."""


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
    simulation = Simulation(edited, _settings(run.simulation, policy))
    pictures = RunFilm(simulation, run.film_width)
    rate = max(1, round(run.simulation.rate_hz))
    driven: list[_Driven] = []
    if policy is None:
        write_video(film, [pictures.frame(simulation, "no policy")], pictures.size, rate, job.crf)
    else:
        driven = [
            _Driven(simulation, policy, seed, run.timeout_s, pictures, n == 0) for n, seed in enumerate(run.seeds)
        ]
        write_video(film, driven[0].frames, pictures.size, rate, job.crf)
    failures = (own.episode.failed for own in driven)
    return {
        "schema": 1,
        "run": run.model_dump(mode="json"),
        "edit": None if job.edit is None else job.edit.model_dump(mode="json"),
        "failed": refused or next(filter(None, failures), None),
        "episodes": [own.figures() for own in driven],
    }


def _settings(settings: SimulationSettings, policy: Policy | None) -> SimulationSettings:
    """The settings of a run whose policy may follow the recording."""
    if getattr(policy, "follows_recording", False):
        return settings.model_copy(update={"recorded_until": 36000.0})
    return settings


class _Driven:
    """An episode with the validity of its images, and with `frames` of its film if it is `filmed`."""

    def __init__(
        self, simulation: Simulation, policy: Policy, seed: int, timeout_s: float, pictures: RunFilm, filmed: bool
    ):
        self.frames: list[np.ndarray] = []
        self._views: list[ViewValidity] = []

        def look(now: Simulation) -> None:
            known = None if pictures.camera is None else now.validity(pictures.camera)
            if known is not None:
                self._views.append(known)
            if filmed:
                touched = now.contacts()
                note = f"contact with {', '.join(touched)}" if touched else ""
                self.frames.append(pictures.frame(now, note, None if known is None else known.validity))

        self.episode: Episode = driven_episode(simulation, policy, seed, timeout_s, look)

    def figures(self) -> dict[str, Any]:
        """The episode as plain data: its scores, the path of the ego vehicle, how far its images can be trusted, and
        the seconds up to which they can (None: to the end)."""
        run, views = self.episode.run, self._views
        headings = np.arctan2(run.ego_to_world[:, 1, 0], run.ego_to_world[:, 0, 0])
        path = np.column_stack([run.seconds, run.ego_to_world[:, :3, 3], headings, run.speed, run.steering])
        doubtful = np.flatnonzero([view.validity < BELIEVABLE for view in views])
        expected = [view.expected_psnr for view in views]
        return {
            "seed": self.episode.seed,
            "ended": self.episode.ended,
            "failed": self.episode.failed,
            "scores": run_scores(run).summary,
            "believable_s": float(run.seconds[doubtful[0]] - run.seconds[0]) if len(doubtful) else None,
            "validity": [round(view.validity, 3) for view in views],
            "expected_psnr": [None if value is None else round(value, 2) for value in expected],
            "path_columns": ["seconds", "x", "y", "z", "yaw", "speed", "steering"],
            "path": np.round(path, 4).tolist(),
        }
