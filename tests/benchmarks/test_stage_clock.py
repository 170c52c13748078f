"""Where the time of an iteration goes: what a clock says of stages, and that it changes nothing of what is trained."""

from pathlib import Path

import pytest
import torch
from helpers.trainings import folders_of, recorded_views, settings_of, untrained

from benchmarks.speed.stage_clock import OTHER, StageClock
from drivesplat.training.loop import train
from drivesplat.training.step import ITERATION, UNTIMED, Clock

pytestmark = pytest.mark.usefixtures("one_thread")
CPU = torch.device("cpu")


@pytest.fixture
def time_passes(monkeypatch):
    """Lets the time of clocks pass by so many seconds."""
    now = [100.0]
    monkeypatch.setattr("benchmarks.speed.stage_clock.time.perf_counter", lambda: now[0])

    def by(seconds: float) -> None:
        now[0] += seconds

    return by


def test_stages_have_their_mean_time_an_iteration_and_the_rest_is_other(time_passes):
    """After one iteration of warm-up two of 9 and 11 s: 2 and 4 s in the first stage, 5 s in the second of one."""
    clock = StageClock(CPU, warm_up=1)
    for first, second, rest in ((70.0, 80.0, 90.0), (2.0, 5.0, 2.0), (4.0, None, 7.0)):
        with clock.stage(ITERATION):
            with clock.stage("first"):
                time_passes(first)
            if second is not None:
                with clock.stage("second"):
                    time_passes(second)
            time_passes(rest)
        time_passes(1000.0)
    shares = clock.shares()
    assert list(shares) == ["first", "second", OTHER, ITERATION]
    assert {name: share.device_ms for name, share in shares.items()} == {
        "first": 3000.0, "second": 2500.0, OTHER: 4500.0, ITERATION: 10_000.0
    }  # fmt: skip
    assert all(share.host_ms == share.device_ms for share in shares.values())


def test_the_stages_of_a_training_are_timed_and_it_learns_the_same(tmp_path):
    def trained(folder: Path, clock: Clock) -> torch.nn.Module:
        settings = settings_of(iterations=12)
        model = untrained(settings, sky=True)
        train(model, recorded_views(), settings, 3, CPU, folders_of(folder, "f"), clock=clock)
        return model

    clock = StageClock(CPU, warm_up=2)
    timed, untimed = trained(tmp_path / "timed", clock), trained(tmp_path / "untimed", UNTIMED)
    shares = clock.shares()
    assert list(shares) == [
        "data", "render", "loss", "backward", "optimizer", "checks", "densification", OTHER, ITERATION,
    ]  # fmt: skip
    assert sum(share.device_ms for share in shares.values()) == pytest.approx(2 * shares[ITERATION].device_ms)
    assert all(share.device_ms > 0 for share in shares.values())
    assert shares["backward"].device_ms > shares["data"].device_ms
    expected = untimed.state_dict()
    assert all(torch.equal(value, expected[name]) for name, value in timed.state_dict().items())


@pytest.mark.gpu
def test_on_a_gpu_what_it_works_on_counts_not_when_python_goes_on():
    device = torch.device("cuda")
    matrix = torch.rand(4096, 4096, device=device)
    clock = StageClock(device, warm_up=2)
    for _ in range(6):
        with clock.stage(ITERATION):
            with clock.stage("work"):
                for _ in range(20):
                    matrix @ matrix
            with clock.stage("nothing"):
                pass
    shares = clock.shares()
    assert shares["work"].device_ms > 5 * shares["work"].host_ms
    assert shares["nothing"].device_ms < 0.1 * shares["work"].device_ms
