"""The stage `run`: a policy drives in a trained drive, into figures and a film."""

from collections.abc import Iterator
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
    episodes: list[Episode] = []
    pictures = RunFilm(simulation, run.film_width)
    rate = max(1, round(run.simulation.rate_hz))
    if policy is None:
        still = pictures.frame(simulation, "no policy")
        write_video(film, [still], pictures.size, rate, job.crf)
    else:
        frames = _filmed(simulation, policy, run.seeds[0], run.timeout_s, pictures, episodes)
        write_video(film, frames, pictures.size, rate, job.crf)
        for seed in run.seeds[1:]:
            episodes.append(driven_episode(simulation, policy, seed, run.timeout_s))
    return {
        "schema": 1,
        "run": run.model_dump(mode="json"),
        "edit": None if job.edit is None else job.edit.model_dump(mode="json"),
        "failed": refused or next((episode.failed for episode in episodes if episode.failed), None),
        "episodes": [_figures(episode) for episode in episodes],
    }


def _settings(settings: SimulationSettings, policy: Policy | None) -> SimulationSettings:
    """The settings of a run whose policy may follow the recording."""
    if getattr(policy, "follows_recording", False):
        return settings.model_copy(update={"recorded_until": 36000.0})
    return settings


def _filmed(
    simulation: Simulation, policy: Policy, seed: int, timeout_s: float, pictures: RunFilm, episodes: list[Episode]
) -> Iterator[np.ndarray]:
    """The frames of an episode, which is appended to `episodes`."""
    frames: list[np.ndarray] = []

    def keep(now: Simulation) -> None:
        touched = now.contacts()
        frames.append(pictures.frame(now, f"contact with {', '.join(touched)}" if touched else ""))

    episodes.append(driven_episode(simulation, policy, seed, timeout_s, keep))
    yield from frames


def _figures(episode: Episode) -> dict[str, Any]:
    """An episode as plain data: its scores, and the path of the ego vehicle."""
    run = episode.run
    scores = run_scores(run)
    places = run.ego_to_world[:, :3, 3]
    headings = np.arctan2(run.ego_to_world[:, 1, 0], run.ego_to_world[:, 0, 0])
    path = np.column_stack([run.seconds, places, headings, run.speed, run.steering])
    return {
        "seed": episode.seed,
        "ended": episode.ended,
        "failed": episode.failed,
        "scores": scores.summary,
        "path_columns": ["seconds", "x", "y", "z", "yaw", "speed", "steering"],
        "path": np.round(path, 4).tolist(),
    }
