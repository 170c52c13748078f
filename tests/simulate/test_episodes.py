"""Episodes of policies, also of those that fail, on a finished workflow."""

import re
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest
import torch

import drivesplat
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.io.video import read_footage
from drivesplat.settings.simulate import RunJob, RunSettings, SimulationSettings
from drivesplat.simulate.episodes import Episode, driven_episode
from drivesplat.simulate.run_stage import drive_runs
from drivesplat.simulate.simulation import Simulation

pytestmark = pytest.mark.workflow
BROKEN = """
class Broken:
    def reset(self, seed):
        raise ValueError("no weights")

    def act(self, seen, facts):
        return [0.0, 0.0]
"""


@pytest.fixture(scope="module")
def drive(finished_run) -> TrainedDrive:
    return drivesplat.open(finished_run.folder / "results/0001/street", device="cpu")


def policy(act, **others) -> SimpleNamespace:
    return SimpleNamespace(act=act, **others)


def driven(drive: TrainedDrive, act, timeout_s: float = 20.0, seed: int = 0, reset=None, **settings) -> Episode:
    simulation = Simulation(drive, SimulationSettings.model_validate({"cameras": (), "seconds": 1.0, **settings}))
    own = policy(act) if reset is None else policy(act, reset=reset)
    return driven_episode(simulation, own, seed, timeout_s)


def raising(*_):
    raise ValueError("no\nidea")


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (raising, "the policy's `act` raised ValueError: no$"),
        (lambda *_: [np.nan, 0.0], "an action is steering and acceleration"),
        (lambda *_: [0.0], "an action is steering and acceleration"),
        (lambda *_: "left", "no array of numbers"),
        (lambda *_: torch.zeros(2, requires_grad=True), "no array of numbers"),
        (lambda *_: None, "an action is steering and acceleration"),
    ],
)
def test_a_policy_that_fails_ends_its_episode_in_one_sentence(drive, act, message):
    found = driven(drive, act)
    assert found.ended == "a failed policy" and len(found.run) == 1
    assert found.failed.startswith("at 0.00 s: ") and "\n" not in found.failed
    assert re.search(message, found.failed)


def test_a_policy_that_hangs_is_given_up(drive):
    released = threading.Event()
    try:
        found = driven(drive, lambda *_: released.wait(), timeout_s=0.2)
        assert found.failed == "at 0.00 s: the policy's `act` took longer than 0.2 s"
    finally:
        released.set()


def test_a_policy_is_told_its_seed_and_may_fail_at_that(drive):
    told = []
    found = driven(drive, lambda *_: [0.0, 0.0], seed=7, reset=told.append, traffic={"vehicles": "replay"})
    assert told == [7] and found.seed == 7 and found.failed is None
    assert driven(drive, lambda *_: [0.0, 0.0], reset=raising).failed == (
        "at 0.00 s: the policy's `reset` raised ValueError: no"
    )


def test_an_episode_ends_with_its_time_at_a_contact_or_too_far_from_the_path(drive):
    stands = driven(drive, lambda *_: [0.0, -8.0])
    assert stands.ended == "the end of its time" and len(stands.run) == 11
    aside = driven(drive, lambda *_: [0.5, 0.0], max_offset=0.2, seconds=3.0, end_on_collision=False)
    assert re.fullmatch(r"0\.\d m from the recorded path", aside.ended) and len(aside.run) < 31
    rams = driven(drive, lambda *_: [0.0, 3.0], seconds=4.0, traffic={"vehicles": "replay"})
    assert rams.ended.startswith("a contact with ") or len(rams.run) == 41


def test_a_run_whose_policy_fails_at_once_has_a_film(drive, tmp_path, monkeypatch):
    (tmp_path / "broken_policy.py").write_text(BROKEN)
    monkeypatch.syspath_prepend(str(tmp_path))
    run = RunSettings(policy="broken_policy:Broken", film_width=64, seeds=(0, 1))
    record = drive_runs(drive, RunJob(run=run, edit=None, code=None, crf=20), tmp_path / "run.mp4")
    assert record["failed"] == "at 0.00 s: the policy's `reset` raised ValueError: no weights"
    assert len(record["episodes"]) == 2 and read_footage(tmp_path / "run.mp4").frames == 1
    monkeypatch.delitem(sys.modules, "broken_policy")


def test_a_run_of_no_policy_says_so(drive, tmp_path):
    run = RunSettings(policy="nobody", film_width=64)
    record = drive_runs(drive, RunJob(run=run, edit=None, code=None, crf=20), tmp_path / "run.mp4")
    assert record["failed"].startswith("there is no policy 'nobody'") and record["episodes"] == []


def test_the_recorded_policy_drives_whatever_actions_are(drive, tmp_path):
    settings = {"actions": "poses", "seconds": 0.5, "cameras": ()}
    run = RunSettings(policy="recorded", film_width=64, simulation=settings)
    (episode,) = drive_runs(drive, RunJob(run=run, edit=None, code=None, crf=20), tmp_path / "run.mp4")["episodes"]
    assert episode["failed"] is None and episode["scores"]["max_path_offset_m"] < 0.02


def test_what_is_done_at_each_step_sees_the_state_of_that_step(drive):
    simulation = Simulation(drive, SimulationSettings(cameras=(), seconds=0.5, end_on_collision=False))
    times = []
    driven_episode(simulation, policy(lambda *_: [0.0, 0.0]), 0, 20.0, lambda now: times.append(now.time))
    np.testing.assert_allclose(times, 0.1 * np.arange(6), atol=1e-9)
