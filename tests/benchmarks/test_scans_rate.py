"""Scans per second: what the benchmark renders and counts."""

import json

import pytest
import torch

import benchmarks.scans as command
from benchmarks.scans import ROUNDS, Street, measure, seconds_of
from drivesplat.rasterization import RayGrid, ScanMotion, rasterize_scan


def test_the_street_is_the_same_in_every_run_and_fills_the_rays_below_the_horizon():
    street = Street.random(20_000, torch.device("cpu"))
    assert all(torch.equal(a, b) for a, b in zip(street, Street.random(20_000, torch.device("cpu")), strict=True))
    assert len(street.means) == 20_000 and bool((street.means[:, :2].norm(dim=1) <= 80.01).all())
    azimuths = torch.linspace(-3.1, 3.1, 90).expand(4, 90).contiguous()
    elevations = torch.deg2rad(torch.tensor([-20.0, -12.0, -8.0, -4.0]))[:, None].expand(4, 90).contiguous()
    rays = RayGrid(azimuths, elevations, torch.zeros(4, 90))
    scan = rasterize_scan(*street[:5], torch.eye(4), rays, beam_spread=command.BEAM_SPREAD)
    assert float((scan.alpha > 0.5).float().mean()) > 0.9


def test_a_rate_counts_rounds_after_the_first(monkeypatch):
    """Every call takes 1 s by the test clock, 10 s in the round that is not counted."""
    now, calls = {"s": 0.0}, []

    def work() -> None:
        calls.append(None)
        now["s"] += 10.0 if len(calls) <= 3 else 1.0

    monkeypatch.setattr(command.time, "perf_counter", lambda: now["s"])
    assert seconds_of(work, 3, torch.device("cpu")) == pytest.approx(1.0)
    assert len(calls) == 3 * (ROUNDS + 1)


def test_scans_with_motion_are_those_of_a_sensor_and_of_gaussians_that_move(monkeypatch):
    rendered = []

    def recorded(*arguments, motion=None, **options):
        rendered.append(motion)
        return rasterize_scan(*arguments, motion=motion, **options)

    monkeypatch.setattr(command, "rasterize_scan", recorded)
    found = measure(Street.random(200, torch.device("cpu")), 2, 16, 1)
    kinds = [isinstance(motion, ScanMotion) for motion in rendered]
    assert kinds == [True] * (ROUNDS + 1) + [False] * (ROUNDS + 1) + [True] * (ROUNDS + 1)
    assert rendered[0].velocities.shape == (200, 3) and bool(rendered[0].linear.any())
    assert all(value > 0 for value in found.values())


@pytest.mark.parametrize("rays", ["32", "32x", "x16", "0x16", "2x-8", "axb"])
def test_a_grid_that_is_none_is_refused_in_a_sentence(rays, capsys):
    with pytest.raises(SystemExit):
        command.main(["--rays", rays])
    assert f"'{rays}' is not a number of beams and of firings" in capsys.readouterr().err


def test_the_command_prints_a_record_for_each_grid(capsys):
    assert command.main(["--gaussians", "300", "--rays", "2x8", "3x16", "--scans", "1"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["gaussians"] == 300 and set(found) == {"device", "gaussians", "2x8", "3x16"}
