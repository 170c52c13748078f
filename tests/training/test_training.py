"""A training from its first iteration to its files: what it learns, and what it survives."""

import dataclasses
import errno
import json
import logging
import math
import multiprocessing
import os
import pickle
import resource
import signal
import sys
import time
from itertools import pairwise
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.patience import PATIENCE_S
from helpers.trainings import (
    ALL_TERMS,
    CHECKPOINT_AT,
    CPU,
    ENDED_AT,
    HEIGHT,
    ITERATIONS,
    PROVENANCE,
    WIDTH,
    EndedError,
    EndingViews,
    files_in,
    folders_of,
    guided_views,
    in_subprocess,
    inputs_in,
    job_of,
    mean_psnr,
    parser_record,
    recorded_views,
    same_parameters,
    settings_of,
    trained,
    untrained,
    untrained_street,
)
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from drivesplat.errors import DeviceError, ResultError, TrainingError
from drivesplat.io import checkpoint_file
from drivesplat.lidar.depth_record import PixelDepths
from drivesplat.model.checkpoint import read_checkpoint, trained_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import view_of
from drivesplat.scene.images import below_horizon
from drivesplat.scene.rigid import rigid
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.drifting import DriftingSettings
from drivesplat.settings.train import (
    ActorSettings,
    DefaultSettings,
    GaussianSettings,
    TrainJob,
)
from drivesplat.settings.train_geometry import FloaterSettings, RoadSettings
from drivesplat.training import resume_state
from drivesplat.training.loop import Trainer, TrainingSummary, train
from drivesplat.training.monitor import NEVER, FiniteGuard, Monitor
from drivesplat.training.optimizers import make_optimizers, set_learning_rates
from drivesplat.training.probes import Probes
from drivesplat.training.road import driven_road
from drivesplat.training.schedule import Schedule
from drivesplat.training.stage import TrainingFiles, mean_sky_color, run_training
from drivesplat.training.views import Supervision, TrainingView, load_views, view_index

pytestmark = pytest.mark.usefixtures("one_thread")

NO_SUPERVISION = Supervision(sky={}, moving={}, lidar={})


def train_whole_and_until_killed(folder: str) -> None:
    """For a subprocess: a whole training with resume states, after which it says whether torch's compiler was read,
    and one that ends itself as `kill -9` would."""
    torch.set_num_threads(1)
    trained(Path(folder, "whole"), settings_of())
    print("torch._dynamo" in sys.modules, flush=True)
    trained(Path(folder, "killed"), settings_of(), EndingViews(recorded_views(), ENDED_AT, kill=True))


def hold_the_lock(folder: Path, held: Connection) -> None:
    """For a forked process: a trainer that works until it is killed."""
    with resume_state.training_lock(folder):
        held.send("held")
        signal.pause()


@dataclasses.dataclass(frozen=True)
class Killed:
    """What became of the process of `train_whole_and_until_killed`; `folder` is of the killed training."""

    folder: Path
    status: int
    output: str
    errors: str


@pytest.fixture(scope="module")
def killed(tmp_path_factory) -> Killed:
    folder = tmp_path_factory.mktemp("trainings")
    process = in_subprocess(train_whole_and_until_killed, str(folder))
    output, errors = process.communicate(timeout=PATIENCE_S)
    return Killed(folder / "killed", process.returncode, output, errors)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> dict[str, tuple[SplatModel, TrainingSummary]]:
    """By strategy, a training that nothing disturbed."""
    folder = tmp_path_factory.mktemp("uninterrupted")
    return {s: trained(folder / s, settings_of(s)) for s in ("mcmc", "default")}


# ---- what it learns


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_a_training_comes_nearer_to_its_images(uninterrupted, strategy):
    views = recorded_views()
    model, summary = uninterrupted[strategy]
    assert mean_psnr(model, views) > mean_psnr(untrained(settings_of()), views) + 3.0
    assert summary.iterations == ITERATIONS and summary.resumed_at == []
    assert 90 < summary.gaussians == len(model) <= 200
    assert summary.peak_gpu_memory_gb is None and summary.device.startswith("cpu")


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_one_seed_gives_one_result_on_the_cpu(uninterrupted, strategy, tmp_path):
    again, _ = trained(tmp_path, settings_of(strategy))
    assert same_parameters(again, uninterrupted[strategy][0])


def test_visits_see_the_model_and_neither_change_it_nor_count_as_training(tmp_path, monkeypatch):
    settings, views, seen = settings_of(iterations=10), recorded_views(), []

    def see(step: int, seconds: float, model: SplatModel) -> None:
        assert not torch.is_grad_enabled()
        seen.append((step, seconds, mean_psnr(model, views)))
        away.append(3600.0)

    visited, plain = untrained(settings), untrained(settings)
    away, clock = [], time.monotonic  # a probe takes an hour
    monkeypatch.setattr(time, "monotonic", lambda: clock() + sum(away))
    summary = train(visited, views, settings, 0, CPU, folders_of(tmp_path / "a", ""), probes=Probes(4, see))
    assert summary.seconds < 3600.0
    assert [step for step, *_ in seen] == [3, 5, 8, 10]
    assert all(0.0 < earlier[1] < later[1] < summary.seconds + 0.1 for earlier, later in pairwise(seen))
    train(plain, views, settings, 0, CPU, folders_of(tmp_path / "b", ""))
    assert same_parameters(visited, plain) and seen[-1][2] == pytest.approx(mean_psnr(plain, views))


def test_another_seed_gives_another_result(uninterrupted, tmp_path):
    other, summary = trained(tmp_path, settings_of(), seed=1)
    assert summary.random_seed == 1
    assert not torch.equal(other.parts[0].params["means"], uninterrupted["mcmc"][0].parts[0].params["means"])


def test_a_sky_learns_too(tmp_path):
    settings = settings_of(iterations=20)
    model = untrained(settings, sky=True)
    views = [TrainingView(v.view, torch.zeros_like(v.pixels), None) for v in recorded_views()]
    trained(tmp_path, settings, views, model=model)
    assert (torch.sigmoid(model.sky.params["color"]) < 0.48).all()


def test_actors_learn_with_the_background_but_for_those_that_are_absent():
    """Views at 0 and 0.5 s see the first car; the second comes at 0.75 s."""
    settings = settings_of(refine_start=1.0, **ALL_TERMS)
    model = untrained_street(settings)
    trainer = Trainer.begin(model, guided_views()[:2], settings, 0, CPU)
    before = {name: value.detach().clone() for name, value in model.named_parameters()}
    for _ in range(15):
        trainer.training_step()
        trainer.state.step += 1
    moved = {name: (value.detach() - before[name]).abs() for name, value in model.named_parameters()}
    first, second = (model.parts[1].params["owner"] == i for i in (0, 1))
    for name in ("means", "scales", "opacities", "sh0", "shN"):
        assert moved[f"parts.0.params.{name}"].max() > 0.0
        assert moved[f"parts.1.params.{name}"][first].max() > 0.0
        assert not moved[f"parts.1.params.{name}"][second].any()
    for name in ("translation", "yaw"):
        assert moved[f"parts.1.shared.{name}"][:2].max() > 1e-4 and not moved[f"parts.1.shared.{name}"][5:].any()
    assert not moved["parts.1.params.owner"].any()


def test_a_degree_that_is_not_shown_as_yet_does_not_learn():
    """Neither of static nor of turning parts."""
    settings = settings_of(sh_every=1.0, refine_start=1.0)
    model = untrained_street(settings)
    trainer = Trainer.begin(model, recorded_views(), settings, 0, CPU)
    for _ in range(5):
        trainer.training_step()
        trainer.state.step += 1
    assert all(part.params["shN"].numel() and not part.params["shN"].any() for part in model.parts)


def test_gaussians_that_leave_their_actors_box_are_put_back_among_the_others(tmp_path):
    settings = settings_of(iterations=7, refine_start=0.0, refine_stop=1.0, floaters=FloaterSettings(radius=0))
    model = untrained_street(settings)
    actors = model.parts[1]
    with torch.no_grad():
        actors.params["means"][:4] += 3.0
        actors.params["opacities"].fill_(1.0)
    trained(tmp_path, settings, model=model)
    assert len(actors) >= 50 and float(actors.params["means"].detach().abs().max()) < 1.5


def test_actors_are_no_floaters(tmp_path):
    """Their places are their boxes', near zero as the cameras of these views are."""
    settings = settings_of(iterations=7, refine_start=1.0, floaters=FloaterSettings(every=7, radius=3.5))
    model = untrained_street(settings)
    trained(tmp_path, settings, model=model)
    still, actors = (torch.sigmoid(part.params["opacities"].detach()) for part in model.parts)
    assert (still < 1e-3).any() and not (actors < 1e-3).any()


@pytest.mark.parametrize("fades", [False, True])
def test_gaussians_below_the_road_fade_where_wanted(tmp_path, fades):
    """The road lies above all Gaussians."""
    poses, wide = np.eye(4)[None], RoadSettings(half_width=10.0, reach=0.01)
    poses[0, 2, 3] = 4.5
    floaters = FloaterSettings(every=7, radius=0, below_road=fades)
    settings = settings_of(iterations=7, refine_start=1.0, floaters=floaters, road_weight=0.1)
    model, road = untrained_street(settings), driven_road(poses, wide)
    low = road.is_above(model.parts[0].params["means"].detach())
    assert low.any()
    train(model, recorded_views(), settings, 0, CPU, folders_of(tmp_path, "of this training"), road)
    still, actors = (torch.sigmoid(part.params["opacities"].detach()) for part in model.parts)
    assert bool((still[low] < 1e-3).all()) == fades and not (actors < 1e-3).any()


def test_an_iteration_with_dropout_leaves_out_static_gaussians_and_others_next_time():
    settings = settings_of(dropout=0.3)
    trainer = Trainer.begin(untrained_street(settings), recorded_views(), settings, 0, CPU)
    still, _ = trainer.state.model.rows
    left_out = []
    for _ in range(2):
        _, picture, _ = trainer.training_step()
        left_out.append(picture.shapes.opacities[still] == 0.0)
    assert all(0.1 < float(mask.float().mean()) < 0.5 for mask in left_out) and not torch.equal(*left_out)
    assert (trainer.state.model.at(0.0).opacities[still] > 0.0).all()


@pytest.mark.parametrize(("limit", "farthest"), [(50.0, 50.0), (None, 7e5)])
def test_gaussians_stay_within_the_maximum_distance(tmp_path, limit, farthest):
    """The cameras of these views are near the origin; the last iteration ends with a check."""
    settings = settings_of(iterations=3, refine_start=1.0, max_distance=limit)
    model = untrained_street(settings)
    with torch.no_grad():
        for part in model.parts:
            part.params["means"][0] = torch.tensor([3e5, -6e5, 2e5])
    trained(tmp_path, settings, model=model)
    for part in model.parts:
        far = part.params["means"].detach()[0]
        assert float(far.norm()) == pytest.approx(farthest, rel=1e-4)
        assert torch.allclose(far / far.norm(), torch.tensor([3.0, -6.0, 2.0]) / 7.0, atol=1e-3)


def test_a_training_applies_the_flatness_and_road_losses():
    """The terms are among those of an iteration, and pull on the background."""
    settings = settings_of(flatness_weight=0.2, road_weight=0.3)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 2, 3], poses[:, 0, 3] = 4.5, [-1.0, 1.0]
    road = driven_road(poses, settings.road)
    trainer = Trainer.begin(untrained(settings), recorded_views(), settings, 0, CPU, road)
    before = trainer.state.model.at(0.0)
    terms, *_ = trainer.training_step()
    torch.testing.assert_close(terms["flatness"], 0.2 * before.scales.amin(dim=1).mean())
    assert float(terms["road"].detach()) > 0.0
    plain = Trainer.begin(untrained(settings_of()), recorded_views(), settings_of(), 0, CPU)
    assert plain.training_step()[0].keys() == terms.keys() - {"flatness", "road"}


def test_static_methods_have_no_settings_of_dynamic_parts():
    """So that a change of these leaves trainings without moving parts as they are."""
    still, all_parts = ("background",), ("background", "actors")
    changed = {"iterations": 70, "depth_weight": 0.2, "sky_bce_weight": 0.3, "opacity_reg": 0.5}
    moving = {"actors": ActorSettings(fourier=2), "entropy_weight": 0.7, "dynamic_weight": 0.9}
    settings = settings_of(**changed, **moving)
    assert settings.for_parts(still) == settings_of(**changed) and settings.for_parts(all_parts) == settings
    assert {name for name, value in settings if getattr(settings.for_parts(still), name) != value} == set(moving)


def test_a_moving_part_knows_no_settings_of_other_moving_parts():
    moving = {"actors": ActorSettings(fourier=2), "drifting": DriftingSettings(fraction=0.1)}
    settings = settings_of(**moving, dynamic_weight=0.9)
    kept = settings.for_parts(("background", "actors"))
    assert kept == settings.model_copy(update={"drifting": DriftingSettings()})


def test_parts_that_move_without_objects_know_no_loss_weights_of_objects():
    kept = {"drifting": DriftingSettings(fraction=0.1)}
    settings = settings_of(**kept, entropy_weight=0.7, dynamic_weight=0.9)
    assert settings.for_parts(("background", "drifting")) == settings_of(**kept)


@pytest.mark.parametrize(("step", "factor"), [(0, 1.0), (50, 0.1), (100, 0.01)])
def test_positions_learn_ever_more_slowly(step, factor):
    model = untrained(settings_of())
    optimizers = make_optimizers(model)
    before = {name: optimizer.param_groups[0]["lr"] for name, optimizer in optimizers.all()}
    set_learning_rates(model, optimizers, Schedule.of(settings_of(iterations=100), 1), step)
    after = {name: optimizer.param_groups[0]["lr"] for name, optimizer in optimizers.all()}
    assert after.pop("0.means") == pytest.approx(2e-3 * factor)
    assert after == {name: rate for name, rate in before.items() if name != "0.means"}


@pytest.mark.parametrize(("step", "degree"), [(0, 0), (9, 0), (10, 1), (25, 2), (35, 3)])
def test_spherical_harmonics_gain_a_degree_at_a_time(step, degree):
    settings = settings_of(iterations=100, sh_every=0.1, gaussians=GaussianSettings(sh_degree=3))
    trainer = Trainer.begin(untrained(settings), recorded_views(), settings, 0, CPU)
    trainer.state.step = step
    assert trainer.state.sh_degree == degree


@pytest.mark.parametrize(("still", "moving"), [(0, 2), (2, 1)])
def test_the_degree_of_spherical_harmonics_grows_to_the_highest_of_any_part(still, moving):
    settings = settings_of(gaussians=GaussianSettings(sh_degree=still), actors=ActorSettings(sh_degree=moving))
    trainer = Trainer.begin(untrained_street(settings), recorded_views(), settings, 0, CPU)
    assert [part.sh_degree for part in trainer.state.model.parts] == [still, moving]
    trainer.state.step = settings.iterations
    assert trainer.state.sh_degree == max(still, moving)


# ---- the images


@pytest.mark.parametrize("count", [1, 2, 7])
def test_every_epoch_sees_every_view_once_in_an_order_of_its_own(count):
    epochs = [[view_index(count, epoch * count + i, seed=5) for i in range(count)] for epoch in range(8)]
    assert all(sorted(epoch) == list(range(count)) for epoch in epochs)
    assert count == 1 or len({tuple(epoch) for epoch in epochs}) > 1
    assert epochs == [[view_index(count, epoch * count + i, seed=5) for i in range(count)] for epoch in range(8)]


def test_the_order_of_views_depends_on_the_seed():
    assert [view_index(20, i, seed=1) for i in range(20)] != [view_index(20, i, seed=2) for i in range(20)]


def test_views_are_the_training_images_and_no_others(tmp_path):
    recorded = recorded_views()
    loaded = load_views(parser_record(tmp_path, recorded), NO_SUPERVISION, CPU)
    assert len(loaded) == 4
    for view, expected in zip(loaded, [recorded[i] for i in (0, 1, 3, 4)], strict=True):
        assert torch.equal(view.pixels, expected.pixels) and view.sky is None
        torch.testing.assert_close(view.view.camera_to_world, expected.view.camera_to_world)
        assert view.view.time == pytest.approx(expected.view.time)
        assert view.target().dtype == torch.float32 and float(view.target().max()) <= 1.0


def test_views_know_what_guides_say_of_their_image(tmp_path):
    """By the image's number among all of the scene, of which the third is held out."""
    masks = {i: np.zeros((HEIGHT, WIDTH), dtype=bool) for i in range(5)}
    for i, mask in masks.items():
        mask[i] = True
    depths = {3: PixelDepths(np.array([0, 2], np.int32), np.array([7, 1], np.int32), np.array([4.5, 9.0]))}
    none = PixelDepths(np.zeros(0, np.int32), np.zeros(0, np.int32), np.zeros(0, np.float32))
    supervision = Supervision(sky=masks, moving={i: masks[4 - i] for i in masks}, lidar={**depths, 4: none})
    loaded = dict(
        zip((0, 1, 3, 4), load_views(parser_record(tmp_path, recorded_views()), supervision, CPU), strict=True)
    )
    for i, view in loaded.items():
        assert view.sky.nonzero()[:, 0].unique().tolist() == [i]
        assert view.moving.nonzero()[:, 0].unique().tolist() == [4 - i]
    assert loaded[3].lidar.pixels.tolist() == [7, 2 * WIDTH + 1] and loaded[3].lidar.depth.tolist() == [4.5, 9.0]
    assert loaded[0].lidar is None and loaded[4].lidar is None, "not measured, and nothing measured"


def test_the_time_of_a_view_counts_from_the_first_image(tmp_path):
    record = parser_record(tmp_path, recorded_views())
    assert [view_of(record, i, CPU).time for i in range(5)] == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0])


def test_the_sky_starts_at_the_mean_colour_of_its_pixels():
    views = recorded_views(2)
    masks = [torch.zeros(HEIGHT, WIDTH, dtype=torch.bool) for _ in views]
    masks[0][:3] = True
    masks[1][0, :5] = True
    seen = [TrainingView(v.view, v.pixels, mask) for v, mask in zip(views, masks, strict=True)]
    pixels = np.concatenate([v.pixels.numpy()[mask.numpy()] for v, mask in zip(views, masks, strict=True)])
    np.testing.assert_allclose(mean_sky_color(seen), pixels.mean(axis=0) / 255.0, atol=1e-5)


@pytest.mark.parametrize("known", [True, False])
def test_without_sky_pixels_the_sky_starts_at_the_mean_colour_of_all(known):
    """By night that is dark: what no image shows of the sky stays as it starts."""
    mask, views = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool) if known else None, recorded_views(2)
    everything = np.concatenate([view.pixels.reshape(-1, 3) for view in views]) / 255.0
    found = mean_sky_color([TrainingView(v.view, v.pixels, mask) for v in views])
    np.testing.assert_allclose(found, everything.mean(axis=0), atol=1e-6)


# ---- what it survives


def test_a_training_killed_halfway_resumes_and_ends_as_an_uninterrupted_one(uninterrupted, killed):
    assert killed.status == -signal.SIGKILL, killed.errors
    assert [path.name for path in (killed.folder / "resume").iterdir()] == ["state.npz"]

    resumed, summary = trained(killed.folder, settings_of())
    whole, whole_summary = uninterrupted["mcmc"]
    views = recorded_views()
    assert summary.iterations == whole_summary.iterations == ITERATIONS
    assert summary.resumed_at == [CHECKPOINT_AT]
    assert summary.gaussians == whole_summary.gaussians
    assert mean_psnr(resumed, views) == pytest.approx(mean_psnr(whole, views), abs=0.1)


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_a_resumed_training_is_the_same_training_on_the_cpu(uninterrupted, strategy, tmp_path):
    with pytest.raises(EndedError):
        trained(tmp_path, settings_of(strategy), EndingViews(recorded_views(), ENDED_AT))
    resumed, summary = trained(tmp_path, settings_of(strategy))
    assert summary.resumed_at == [CHECKPOINT_AT]
    assert same_parameters(resumed, uninterrupted[strategy][0])


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_a_resumed_training_of_actors_is_the_same_training_on_the_cpu(strategy, tmp_path):
    """With all terms of the loss, corrections of tracks, and Gaussians that come and go."""
    settings = settings_of(strategy, iterations=30, checkpoint_every=12, refine_start=0.0, **ALL_TERMS)
    whole, summary = trained(tmp_path / "whole", settings, guided_views(), model=untrained_street(settings))
    with pytest.raises(EndedError):
        trained(tmp_path / "it", settings, EndingViews(guided_views(), 20), model=untrained_street(settings))
    resumed, resumed_summary = trained(tmp_path / "it", settings, guided_views(), model=untrained_street(settings))
    assert (summary.resumed_at, resumed_summary.resumed_at) == ([], [12])
    assert same_parameters(resumed, whole)
    assert len(whole.parts[1]) != 50 and whole.parts[1].shared["yaw"].any()


def test_a_training_ended_twice_resumes_twice_and_counts_all_its_time(uninterrupted, tmp_path):
    settings = settings_of(checkpoint_every=20)
    for looks in (25, 25):
        with pytest.raises(EndedError):
            trained(tmp_path, settings, EndingViews(recorded_views(), looks))
    before = checkpoint_file.load(tmp_path / "resume/state.npz", "train")["seconds"]
    resumed, summary = trained(tmp_path, settings)
    assert summary.resumed_at == [20, 40]
    assert summary.seconds > before > 0.0
    assert same_parameters(resumed, uninterrupted["mcmc"][0])


class TickingViews(EndingViews):
    """Training images of which a look takes `look_s` seconds, by the clock that the training sees."""

    seconds = 0.0
    look_s = 1.0

    def __getitem__(self, index: int) -> TrainingView:
        self.seconds += self.look_s
        return super().__getitem__(index)


@pytest.mark.parametrize(("apart", "kept"), [(0.0, 40), (20.5, 30), (39.5, 40), (100.0, None)])
def test_resume_states_come_no_sooner_than_their_time(apart, kept, tmp_path, monkeypatch):
    views = TickingViews(recorded_views(), 45)
    monkeypatch.setattr("drivesplat.training.loop.time", SimpleNamespace(monotonic=lambda: views.seconds))
    with pytest.raises(EndedError):
        trained(tmp_path, settings_of(checkpoint_every=10, min_checkpoint_interval_s=apart), views)
    state = tmp_path / "resume/state.npz"
    assert (checkpoint_file.load(state, "train")["step"] if state.exists() else None) == kept


def test_slow_iterations_are_saved_by_time_and_resume_to_the_same_result(uninterrupted, tmp_path, monkeypatch):
    views = TickingViews(recorded_views(), 45)
    views.look_s = 3.3
    with monkeypatch.context() as patched, pytest.raises(EndedError):
        patched.setattr("drivesplat.training.loop.time", SimpleNamespace(monotonic=lambda: views.seconds))
        trained(tmp_path, settings_of(checkpoint_every=1000), views)
    assert checkpoint_file.load(tmp_path / "resume/state.npz", "train")["step"] == 38, "each 19th look is past 60 s"
    again, summary = trained(tmp_path, settings_of(checkpoint_every=1000))
    assert summary.resumed_at == [38] and same_parameters(again, uninterrupted["mcmc"][0])


def test_a_training_ended_before_its_first_checkpoint_starts_at_0(uninterrupted, tmp_path):
    with pytest.raises(EndedError):
        trained(tmp_path, settings_of(), EndingViews(recorded_views(), CHECKPOINT_AT - 1))
    again, summary = trained(tmp_path, settings_of())
    assert summary.resumed_at == []
    assert same_parameters(again, uninterrupted["mcmc"][0])


def test_the_resume_state_of_another_training_is_ignored_with_a_message(uninterrupted, tmp_path, caplog):
    with pytest.raises(EndedError):
        trained(tmp_path, settings_of(), EndingViews(recorded_views(), ENDED_AT), seed=9, fingerprint="of another")
    with caplog.at_level(logging.WARNING):
        model, summary = trained(tmp_path, settings_of())
    assert "other settings, code or inputs" in caplog.text and "starts at 0" in caplog.text
    assert summary.resumed_at == [] and summary.iterations == ITERATIONS
    assert same_parameters(model, uninterrupted["mcmc"][0])


class Malicious:
    """A pickle of it makes a file when it is loaded."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def spoil(path: Path, kind: str) -> None:
    """Puts something at `path` that no training of this workflow wrote whole."""
    good = {"fingerprint": "of this training", "model": {"means": torch.zeros(50_000)}}
    match kind:
        case "truncated":
            checkpoint_file.save(path, good)
            path.write_bytes(path.read_bytes()[:100_000])
        case "a flipped bit":
            checkpoint_file.save(path, good)
            content = bytearray(path.read_bytes())
            content[100_000] ^= 4
            path.write_bytes(content)
        case "empty":
            path.write_bytes(b"")
        case "text":
            path.write_text("PSNR 42 dB")
        case "a tensor":
            torch.save(torch.zeros(3), path)
        case "malicious":
            torch.save({**good, "extra": Malicious(path.parent / "executed")}, path)
        case "a malicious pickle":
            path.write_bytes(pickle.dumps({**good, "model": Malicious(path.parent / "executed")}, protocol=2))
        case "a whole module":
            torch.save({**good, "model": torch.nn.Linear(2, 2)}, path)


FOREIGN = [
    "truncated",
    "a flipped bit",
    "empty",
    "text",
    "a tensor",
    "malicious",
    "a malicious pickle",
    "a whole module",
]


@pytest.mark.parametrize("kind", FOREIGN)
def test_a_damaged_resume_state_is_ignored_with_a_message_and_nothing_of_it_runs(kind, tmp_path, caplog):
    path = tmp_path / "state.npz"
    spoil(path, kind)
    with caplog.at_level(logging.WARNING):
        assert resume_state.resumable(path, "of this training") is None
    assert str(path) in caplog.text and "starts at 0" in caplog.text
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("kind", [*FOREIGN, "missing", "another record"])
def test_a_foreign_checkpoint_is_refused_by_name_and_nothing_of_it_runs(kind, tmp_path):
    path = tmp_path / "checkpoint.npz"
    spoil(path, kind)
    if kind == "another record":
        checkpoint_file.save(path, {"fingerprint": "", "step": 3})
    with pytest.raises(ResultError) as error:
        read_checkpoint(path)
    assert str(path) in str(error.value) and "'train'" in str(error.value) and "\n" not in str(error.value)
    assert not (tmp_path / "executed").exists()


def test_without_a_resume_state_nothing_is_logged(tmp_path, caplog):
    assert resume_state.resumable(tmp_path / "state.npz", "any") is None
    assert caplog.text == ""


@pytest.mark.parametrize("failure", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()])
def test_a_crash_while_a_checkpoint_is_written_keeps_the_earlier_one(tmp_path, monkeypatch, failure):
    path = tmp_path / "state.npz"
    checkpoint_file.save(path, {"step": 1, "means": torch.ones(3)})

    def half(file: Any, *_: Any, **__: Any) -> None:
        file.write(b"half an array")
        raise failure

    monkeypatch.setattr(np.lib.format, "write_array", half)
    with pytest.raises(ResultError if isinstance(failure, OSError) else KeyboardInterrupt):
        checkpoint_file.save(path, {"step": 2})
    assert checkpoint_file.load(path, "train")["step"] == 1
    assert list(tmp_path.iterdir()) == [path]


def test_a_full_disk_is_reported_with_the_file_name_and_keeps_the_earlier_checkpoint(tmp_path):
    """A limit on the size of files stands for the full disk."""
    path = tmp_path / "state.npz"
    checkpoint_file.save(path, {"step": 1})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8192, limits[1]))
    try:
        with pytest.raises(ResultError, match=r"state\.npz.*cannot be written"):
            checkpoint_file.save(path, {"step": 2, "means": torch.zeros(100_000)})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert checkpoint_file.load(path, "train")["step"] == 1
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_a_second_trainer_is_refused_naming_the_first_and_a_killed_one_frees_the_folder(tmp_path):
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    holder = context.Process(target=hold_the_lock, args=(tmp_path / "resume", there))
    holder.start()
    try:
        assert here.poll(PATIENCE_S) and here.recv() == "held"
        assert_refused(tmp_path / "resume", holder.pid)
    finally:
        holder.kill()
        holder.join()
    with resume_state.training_lock(tmp_path / "resume"):
        assert_refused(tmp_path / "resume", os.getpid())


def assert_refused(folder: Path, process: int) -> None:
    refusal = rf"process {process} is still training in .*{folder.name}"
    with pytest.raises(TrainingError, match=refusal), resume_state.training_lock(folder):
        pass


def test_a_trainer_that_fails_frees_the_folder(tmp_path):
    with pytest.raises(EndedError), resume_state.training_lock(tmp_path):
        raise EndedError
    with resume_state.training_lock(tmp_path):
        pass


# ---- numbers that are none


def test_a_loss_that_is_no_number_stops_the_training_and_keeps_the_last_checkpoint(tmp_path):
    """Colours leap to 1e29 in the first step, so that the second iteration's squares overflow."""
    settings = settings_of(
        checkpoint_every=1,
        log_every=10,
        gaussians=GaussianSettings(sh_degree=1, lr_sh0=1e30),
        opacity_reg=0,
        scale_reg=0,
    )
    with pytest.raises(TrainingError) as error:
        trained(tmp_path, settings)
    message = str(error.value)
    assert message.startswith("iteration 2: ") and "loss ssim" in message and "gradient of background" in message
    assert "opacity_reg" not in message and "scale_reg" not in message
    assert str(tmp_path / "resume/state.npz") in message
    assert checkpoint_file.load(tmp_path / "resume/state.npz", "train")["step"] == 1


@pytest.mark.parametrize("log_every", [1, 50])
@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_a_loss_that_is_not_finite_is_a_training_error_however_rarely_it_is_checked(tmp_path, strategy, log_every):
    """Densification comes between the loss that is no number and the check."""
    settings = settings_of(
        strategy,
        checkpoint_every=1000,
        log_every=log_every,
        refine_start=0.0,
        gaussians=GaussianSettings(sh_degree=1, lr_sh0=1e30),
    )
    with pytest.raises(TrainingError, match=r"^iteration 2: .*not finite"):
        trained(tmp_path, settings)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_the_guard_names_the_first_iteration_and_its_terms_alone(value):
    guard = FiniteGuard(CPU)
    fine, bad = torch.tensor(1.0), torch.tensor(value)
    guard.watch(0, {"loss l1": fine, "loss ssim": fine, "gradient of means": fine})
    guard.check("state.npz")
    guard.watch(6, {"loss l1": fine, "loss ssim": bad, "gradient of means": bad})
    guard.watch(7, {"loss l1": bad, "loss ssim": bad, "gradient of means": bad})
    with pytest.raises(TrainingError) as error:
        guard.check("state.npz")
    message = str(error.value)
    assert "iteration 7: loss ssim, gradient of means is not finite" in message
    assert "loss l1" not in message and "state.npz" in message


def test_the_guard_keeps_its_records_in_memory_that_exists_from_the_beginning(monkeypatch):
    """A CUDA graph that captured their creation would reset them at every replay."""
    monkeypatch.setattr("drivesplat.training.monitor.WATCHED", 3)
    guard, fine, broken = FiniteGuard(CPU), torch.tensor(1.0), torch.tensor(math.nan)
    known = guard._records.data_ptr()
    guard.watch(4, {"a": fine})
    guard.watch(5, {"a": broken, "b": fine})
    guard.watch(6, {"a": broken})
    assert [first.data_ptr() for first in guard._first.values()] == [known, known + 8]
    assert [first.tolist() for first in guard._first.values()] == [[6], [5, NEVER]]
    with pytest.raises(ValueError, match="more than 3 values"):
        guard.watch(7, {"c": fine})


def test_the_guard_keeps_apart_iterations_that_watch_different_terms():
    guard = FiniteGuard(CPU)
    guard.watch(3, {"loss l1": torch.tensor(1.0), "loss sky_alpha": torch.tensor(math.nan)})
    guard.watch(2, {"loss l1": torch.tensor(math.nan)})
    with pytest.raises(TrainingError, match="iteration 3: loss l1 is not finite; "):
        guard.check("state.npz")
    with pytest.raises(TrainingError, match=r"iteration 3: loss l1 \(tracks a, b\) is not finite; "):
        guard.check("state.npz", lambda: ["a", "b"])


@pytest.mark.parametrize("log_every", [1, 50])
@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_a_training_without_gaussians_left_says_so(tmp_path, strategy, log_every):
    settings = settings_of(strategy, log_every=log_every, refine_start=0.0, checkpoint_every=1000)
    model = untrained(settings)
    with torch.no_grad():
        model.parts[0].params["opacities"].fill_(-30.0)
    with pytest.raises(TrainingError, match="no Gaussian is left"):
        trained(tmp_path, settings, model=model)


def test_a_reset_of_all_opacities_is_no_loss_of_gaussians(tmp_path):
    faintest = DefaultSettings(refine_every=1000, reset_every=10, prune_opacity=1e-3, grow_grad2d=1e3)
    settings = settings_of("default", iterations=25, log_every=1, refine_start=0.0, refine_stop=1.0, default=faintest)
    _, summary = trained(tmp_path, settings)
    assert summary.gaussians == 90


def test_views_that_show_no_gaussian_are_no_error(tmp_path):
    settings = settings_of(iterations=10)
    model = untrained(settings)
    with torch.no_grad():
        model.parts[0].params["means"][:, 2] *= -1.0
    _, summary = trained(tmp_path, settings, model=model)
    assert summary.iterations == 10


# ---- what it tells


def test_tensorboard_holds_every_loss_and_pictures(tmp_path):
    trained(tmp_path, settings_of())
    board = EventAccumulator(str(tmp_path / "tensorboard"))
    board.Reload()
    wanted = {"loss/total", "loss/l1", "loss/ssim", "loss/opacity_reg", "loss/scale_reg", "gaussians"}
    assert set(board.Tags()["scalars"]) == wanted
    losses = {name: [event.value for event in board.Scalars(name)] for name in wanted}
    assert [event.step for event in board.Scalars("loss/total")] == [10, 20, 30, 40, 50, 60]
    assert losses["loss/total"][-1] < losses["loss/total"][0]
    parts = [losses[name] for name in wanted - {"loss/total", "gaussians"}]
    np.testing.assert_allclose(losses["loss/total"], np.sum(parts, axis=0), rtol=1e-5)
    assert [event.step for event in board.Images("recorded_and_rendered")] == [30, 60]
    assert {(event.width, event.height) for event in board.Images("recorded_and_rendered")} == {(2 * WIDTH, HEIGHT)}


def test_tensorboards_pictures_show_all_gaussians_also_with_dropout(tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(Monitor, "image", lambda self, step, view, picture: shown.append(picture))
    trained(tmp_path, settings_of(dropout=0.5))
    assert len(shown) == 2
    assert all((picture.shapes.opacities > 0.0).all() and not picture.image.requires_grad for picture in shown)


def test_tensorboard_of_a_resumed_training_has_every_iteration_once(tmp_path):
    with pytest.raises(EndedError):
        trained(tmp_path, settings_of(), EndingViews(recorded_views(), ENDED_AT))
    trained(tmp_path, settings_of())
    board = EventAccumulator(str(tmp_path / "tensorboard"))
    board.Reload()
    assert [event.step for event in board.Scalars("loss/total")] == [10, 20, 30, 40, 50, 60]


# ---- its files


def run(folder: Path, job: TrainJob, device: str = "cpu", actors: bool = False) -> TrainingFiles:
    files = files_in(folder / "vanilla")
    inputs = inputs_in(folder, actors)
    run_training(inputs, job, DeviceSettings(kind=device), files, PROVENANCE, "train")
    return files


def test_a_finished_training_leaves_a_checkpoint_and_a_summary(tmp_path):
    files = run(tmp_path, job_of())
    assert {path.name for path in files.checkpoint.parent.iterdir()} == {"checkpoint.npz", "train.json", "tensorboard"}
    summary = json.loads(files.summary.read_text())
    content = read_checkpoint(files.checkpoint)
    model = trained_model(content)
    assert content.provenance == summary["provenance"] == PROVENANCE
    assert content.job == job_of()
    assert summary["gaussians"] == len(model) and summary["iterations"] == 20 and summary["random_seed"] == 3
    assert summary["peak_gpu_memory_gb"] is None and summary["resumed_at"] == []
    views = recorded_views()
    assert mean_psnr(model, views) > mean_psnr(untrained(settings_of()), views) + 1.0


def test_the_terms_about_surfaces_are_logged(tmp_path):
    files = run(tmp_path, job_of(flatness_weight=0.1, road_weight=0.1))
    board = EventAccumulator(str(files.checkpoint.parent / "tensorboard"))
    board.Reload()
    assert {"loss/flatness", "loss/road"} < set(board.Tags()["scalars"])


def test_a_finished_training_of_actors_can_be_rendered_from_its_checkpoint_alone(tmp_path):
    job = job_of(("background", "actors"), "cubemap", sky_resolution=4, **ALL_TERMS)
    checkpoint = read_checkpoint(run(tmp_path, job, actors=True).checkpoint)
    model = trained_model(checkpoint)
    assert checkpoint.job == job and [part.name for part in model.parts] == ["background", "actors"]
    assert [track.id for track in model.parts[1].timeline.tracks] == ["early", "late"]
    assert model.parts[1].shared["translation"].any(), "tracks were corrected"
    views = recorded_views()
    assert mean_psnr(model, views) > mean_psnr(untrained_street(job.train), views) + 1.0


@pytest.mark.parametrize(
    ("parts", "changes", "known"),
    [
        (("background",), {"dynamic_weight": 0.0}, {"lidar"}),
        (("background", "actors"), {"dynamic_weight": 0.1}, {"lidar", "moving"}),
        (("background", "actors"), {"dynamic_weight": 0.1, "sky_bce_weight": 0.1}, {"lidar", "moving", "sky"}),
    ],
)
def test_only_what_a_training_asks_for_is_read(tmp_path, parts, changes, known):
    """Masks are read by the training images; of people that move, too, is known that they do."""
    supervision = inputs_in(tmp_path, actors=True).supervision(job_of(parts, **changes))
    by_kind = {name: getattr(supervision, name) for name in ("sky", "moving", "lidar")}
    assert {name for name, images in by_kind.items() if images} == known
    assert all(list(images) == [0, 1, 3, 4] for images in by_kind.values() if images)
    if "moving" in known:
        assert supervision.moving[3][HEIGHT // 2 :].all() and not supervision.moving[3][: HEIGHT // 2].any()
    if "sky" in known:
        np.testing.assert_array_equal(supervision.sky[3], np.eye(HEIGHT, WIDTH, 3, dtype=bool))


def test_a_sky_that_is_modelled_is_read(tmp_path):
    assert inputs_in(tmp_path, actors=True).supervision(job_of(sky="cubemap")).sky


def test_where_no_sky_is_known_what_is_below_the_horizon_cannot_be_sky(tmp_path):
    """By night the heuristic finds none: with empty masks the cross entropy would fill the dark sky with Gaussians."""
    inputs = inputs_in(tmp_path, actors=True)
    level = rigid(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
    record = dataclasses.replace(inputs.record, camtoworlds=np.stack([level] * 5))
    inputs = dataclasses.replace(inputs, record=record, sky_known=False)
    losses = {"sky_bce_weight": 0.1, "horizon_weight": 0.1, "dynamic_weight": 0.1}
    supervision = inputs.supervision(job_of(("background", "actors"), sky="cubemap", **losses))
    assert not supervision.sky and supervision.moving and list(supervision.not_sky) == [0, 1, 3, 4]
    for view, i in zip(load_views(inputs.record, supervision, CPU), supervision.not_sky, strict=True):
        expected = below_horizon(record.Ks[i], level, (WIDTH, HEIGHT))
        assert view.sky is None and 0 < expected.sum() < expected.size
        np.testing.assert_array_equal(view.not_sky.numpy(), expected)


@pytest.mark.parametrize(("sky_known", "weight"), [(True, 0.1), (False, 0.0)])
def test_the_horizon_is_not_asked_for_where_the_sky_is_known_or_nothing_uses_it(tmp_path, sky_known, weight):
    inputs = dataclasses.replace(inputs_in(tmp_path, actors=True), sky_known=sky_known)
    assert not inputs.supervision(job_of(sky="cubemap", horizon_weight=weight)).not_sky


def test_a_training_holds_no_more_gaussians_than_its_pixels_allow(tmp_path):
    pixels = 4 * WIDTH * HEIGHT
    files = run(tmp_path, job_of(pixels_per_gaussian=pixels / 95, cap_max=1000, iterations=40, refine_start=0.0))
    assert json.loads(files.summary.read_text())["gaussians"] == 95


def test_a_training_does_not_wait_for_torchs_compiler(killed):
    """Torch's own optimizers read it, for a second or more of every training."""
    assert killed.output == "False\n", killed.output + killed.errors[-3000:]


def test_a_failed_training_leaves_no_result_but_its_resume_state(tmp_path):
    job = job_of(gaussians=GaussianSettings(sh_degree=1, lr_sh0=1e30), checkpoint_every=1)
    with pytest.raises(TrainingError):
        run(tmp_path, job)
    assert {path.name for path in (tmp_path / "vanilla").iterdir()} == {"resume", "tensorboard"}
    assert (tmp_path / "vanilla/resume/state.npz").is_file()


def test_without_a_gpu_a_training_is_refused_before_it_begins(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(DeviceError, match="device: cpu"):
        run(tmp_path, job_of(), device="auto")
    files = files_in(tmp_path / "vanilla")
    assert not files.checkpoint.exists() and not files.summary.exists()


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_actors_that_all_died_do_not_end_a_training(strategy, tmp_path):
    settings = settings_of(strategy, iterations=20, refine_start=0.0, refine_stop=1.0)
    model = untrained_street(settings)
    with torch.no_grad():
        model.parts[1].params["opacities"].fill_(-30.0)
    _, summary = trained(tmp_path, settings, model=model)
    assert summary.iterations == 20


def test_actors_alone_can_be_trained(tmp_path):
    settings = settings_of(iterations=20, gaussians=GaussianSettings(sh_degree=3), sh_every=0.1)
    trained(tmp_path, settings, model=SplatModel([untrained_street(settings).parts[1]], None))
