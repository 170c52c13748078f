"""A training from its first iteration to its files: what it learns, what it survives, and what it tells."""

import copy
import dataclasses
import errno
import json
import logging
import math
import multiprocessing
import os
import random
import signal
import struct
import sys
import time
import zipfile
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
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

from drivesplat.errors import DeviceError, ResultError, TrainingError
from drivesplat.io import checkpoint_file
from drivesplat.lidar.depth_record import PixelDepths
from drivesplat.model.checkpoint import read_checkpoint, trained_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.images import below_horizon
from drivesplat.scene.rigid import rigid
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.drifting import DriftingSettings
from drivesplat.settings.train import (
    ActorSettings,
    DefaultSettings,
    FloaterSettings,
    GaussianSettings,
    RoadSettings,
    TrainJob,
)
from drivesplat.training import resume_state
from drivesplat.training.loop import Trainer, TrainingRun, train
from drivesplat.training.monitor import NEVER, FiniteGuard, Monitor
from drivesplat.training.optimizers import AVERAGED_EVERY, ParameterAverage
from drivesplat.training.probes import MAX_IMAGES, CurveImage, Probes, curve_psnrs, evenly_spaced
from drivesplat.training.road import driven_road
from drivesplat.training.schedule import Schedule
from drivesplat.training.stage import TrainingFiles, mean_sky_color, prepare, run_training
from drivesplat.training.views import Supervision, TrainingView, load_views, view_index

pytestmark = pytest.mark.usefixtures("one_thread")

NO_SUPERVISION = Supervision(sky={}, moving={}, lidar={})
SHORT = settings_of(iterations=30, checkpoint_every=12)
FLIPS = 30
LOCAL_HEADER = struct.Struct("<26xHH")


def train_until_killed(folder: str) -> None:
    """For a subprocess: a training that says whether torch's compiler was read, and one that ends itself as `kill -9`
    would."""
    torch.set_num_threads(1)
    trained(Path(folder, "short"), settings_of(iterations=2))
    print("torch._dynamo" in sys.modules, flush=True)
    trained(Path(folder, "killed"), SHORT, EndingViews(recorded_views(), 20, kill=True))


def hold_the_lock(folder: Path, held: Connection) -> None:
    """For a forked process: a trainer that works until it is killed."""
    with resume_state.training_lock(folder):
        held.send("held")
        signal.pause()


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory) -> SplatModel:
    """The model of a short training that nothing disturbed."""
    return trained(tmp_path_factory.mktemp("uninterrupted"), SHORT)[0]


# ---- what it learns


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_a_training_comes_nearer_to_its_images(strategy, tmp_path):
    views, begun = recorded_views(), untrained(settings_of())
    model, summary = trained(tmp_path, settings_of(strategy), views)
    assert mean_psnr(model, views) > mean_psnr(begun, views) + 3.0
    assert summary.iterations == ITERATIONS and summary.resumed_at == []
    assert 90 < summary.gaussians == len(model) <= 200
    assert summary.peak_gpu_memory_gb is None and summary.device.startswith("cpu")


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
    other, summary = trained(tmp_path, SHORT, seed=1)
    assert summary.random_seed == 1
    assert not torch.equal(other.parts[0].params["means"], uninterrupted.parts[0].params["means"])


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
    assert moved["sky.params.color"].max() > 0.0
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
    actors.params["means"].data[:4] += 3.0
    actors.params["opacities"].data.fill_(1.0)
    trained(tmp_path, settings, model=model)
    assert len(actors) >= 50 and float(actors.params["means"].detach().abs().max()) < 1.5


@pytest.mark.parametrize("below_road", [None, False, True])
def test_floaters_and_gaussians_below_the_road_fade_where_wanted_and_actors_do_not(tmp_path, below_road):
    """Actors' places are their boxes', near zero as the cameras of these views are. The road lies above all."""
    poses, wide = np.eye(4)[None], RoadSettings(half_width=10.0, reach=0.01)
    poses[0, 2, 3] = 4.5
    near_path = FloaterSettings(every=7, radius=3.5)
    floaters = near_path if below_road is None else FloaterSettings(every=7, radius=0, below_road=below_road)
    settings = settings_of(iterations=7, refine_start=1.0, floaters=floaters, road_weight=0.1)
    model, road = untrained_street(settings), driven_road(poses, wide)
    low = road.is_above(model.parts[0].params["means"].detach())
    train(model, recorded_views(), settings, 0, CPU, folders_of(tmp_path, "of this training"), road)
    still, actors = (torch.sigmoid(part.params["opacities"].detach()) < 1e-3 for part in model.parts)
    assert low.any() and not actors.any()
    assert still.any() if below_road is None else still[low].all() == below_road


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


@pytest.mark.parametrize(
    ("parts", "left_out"),
    [
        (("background",), {"actors", "drifting", "entropy_weight", "dynamic_weight"}),
        (("background", "actors"), {"drifting"}),
        (("background", "drifting"), {"actors", "entropy_weight", "dynamic_weight"}),
        (("background", "actors", "drifting"), set()),
    ],
)
def test_methods_have_no_settings_of_parts_that_they_lack(parts, left_out):
    """So that a change of these leaves their trainings as they are."""
    of_all = {"depth_weight": 0.2, "sky_bce_weight": 0.3, "opacity_reg": 0.5}
    moving = {"actors": ActorSettings(fourier=2), "drifting": DriftingSettings(fraction=0.1)}
    changed = {**of_all, **moving, "entropy_weight": 0.7, "dynamic_weight": 0.9}
    kept = {name: value for name, value in changed.items() if name not in left_out}
    assert settings_of(**changed).for_parts(parts) == settings_of(**kept)


@pytest.mark.parametrize(("still", "moving"), [(3, 1), (1, 3), (0, 2)])
def test_spherical_harmonics_gain_a_degree_at_a_time_up_to_the_highest_of_any_part(still, moving):
    degrees = {"gaussians": GaussianSettings(sh_degree=still), "actors": ActorSettings(sh_degree=moving)}
    settings = settings_of(iterations=100, sh_every=0.1, **degrees)
    trainer = Trainer.begin(untrained_street(settings), recorded_views(1), settings, 0, CPU)
    assert [part.sh_degree for part in trainer.state.model.parts] == [still, moving]
    for step, degree in ((0, 0), (9, 0), (10, 1), (25, 2), (35, 3), (100, 3)):
        trainer.state.step = step
        assert trainer.state.sh_degree == min(degree, max(still, moving))


# ---- the images


@pytest.mark.parametrize("count", [1, 2, 7])
def test_every_epoch_sees_every_view_once_in_a_seeded_order_of_its_own(count):
    def orders(seed: int) -> list[list[int]]:
        return [[view_index(count, epoch * count + i, seed) for i in range(count)] for epoch in range(8)]

    epochs = orders(5)
    assert all(sorted(epoch) == list(range(count)) for epoch in epochs) and epochs == orders(5)
    assert count == 1 or (len({tuple(epoch) for epoch in epochs}) > 1 and epochs != orders(6))


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


@pytest.mark.parametrize("sky", ["seen", "not seen", "not known"])
def test_the_sky_starts_at_the_mean_colour_of_its_pixels_or_without_them_of_all(sky):
    """By night that is dark: what no image shows of the sky stays as it starts."""
    views, masks = recorded_views(2), torch.zeros(2, HEIGHT, WIDTH, dtype=torch.bool)
    if sky == "seen":
        masks[0, :3] = masks[1, 0, :5] = True
    seen = [
        TrainingView(v.view, v.pixels, None if sky == "not known" else m) for v, m in zip(views, masks, strict=True)
    ]
    pixels = torch.stack([view.pixels for view in views])[masks if sky == "seen" else ~masks].double()
    np.testing.assert_allclose(mean_sky_color(seen), pixels.mean(dim=0) / 255.0, atol=1e-5)


# ---- what it survives


def test_a_training_killed_halfway_resumes_and_ends_as_an_uninterrupted_one(uninterrupted, tmp_path):
    """And none reads torch's compiler, as torch's own optimizers would, for a second or more."""
    process, killed = in_subprocess(train_until_killed, str(tmp_path)), tmp_path / "killed"
    output, errors = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == -signal.SIGKILL and output == "False\n", output + errors[-3000:]
    assert [path.name for path in (killed / "resume").iterdir()] == ["state.npz"]
    resumed, summary = trained(killed, SHORT)
    assert (summary.iterations, summary.resumed_at) == (30, [12])
    assert summary.gaussians == len(uninterrupted)
    views = recorded_views()
    assert mean_psnr(resumed, views) == pytest.approx(mean_psnr(uninterrupted, views), abs=0.1)


@pytest.mark.parametrize("strategy", ["mcmc", pytest.param("default", marks=pytest.mark.slow)])
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
    settings = settings_of(iterations=30, checkpoint_every=10)
    for looks in (17, 17):
        with pytest.raises(EndedError):
            trained(tmp_path, settings, EndingViews(recorded_views(), looks))
    before = checkpoint_file.load(tmp_path / "resume/state.npz", "train")["seconds"]
    resumed, summary = trained(tmp_path, settings)
    assert summary.resumed_at == [10, 20]
    assert summary.seconds > before > 0.0
    assert same_parameters(resumed, uninterrupted)


class TickingViews(EndingViews):
    """Training images of which a look takes `look_s` seconds, by the clock that the training sees."""

    seconds = 0.0
    look_s = 1.0

    def __getitem__(self, index: int) -> TrainingView:
        self.seconds += self.look_s
        return super().__getitem__(index)


@pytest.mark.parametrize(("apart", "kept"), [(0.0, 16), (8.2, 12), (40.0, None)])
def test_resume_states_come_no_sooner_than_their_time(apart, kept, tmp_path, monkeypatch):
    views = TickingViews(recorded_views(), 23)
    monkeypatch.setattr("drivesplat.training.loop.time", SimpleNamespace(monotonic=lambda: views.seconds))
    with pytest.raises(EndedError):
        trained(tmp_path, settings_of(checkpoint_every=4, min_checkpoint_interval_s=apart), views)
    state = tmp_path / "resume/state.npz"
    assert (checkpoint_file.load(state, "train")["step"] if state.exists() else None) == kept


def test_slow_iterations_are_saved_by_time_and_resume_to_the_same_result(uninterrupted, tmp_path, monkeypatch):
    views, settings = TickingViews(recorded_views(), 27), settings_of(iterations=30, checkpoint_every=1000)
    views.look_s = 6.6
    with monkeypatch.context() as patched, pytest.raises(EndedError):
        patched.setattr("drivesplat.training.loop.time", SimpleNamespace(monotonic=lambda: views.seconds))
        trained(tmp_path, settings, views)
    assert checkpoint_file.load(tmp_path / "resume/state.npz", "train")["step"] == 20, "each tenth look is past 60 s"
    again, summary = trained(tmp_path, settings)
    assert summary.resumed_at == [20] and same_parameters(again, uninterrupted)


def test_without_a_resume_state_of_its_own_a_training_starts_at_0(uninterrupted, tmp_path, caplog):
    """A state of another training, which is worth a warning, changes nothing."""
    with pytest.raises(EndedError):
        trained(tmp_path, SHORT, EndingViews(recorded_views(), 18), seed=9, fingerprint="another training")
    assert (tmp_path / "resume/state.npz").exists()
    with caplog.at_level(logging.WARNING):
        model, summary = trained(tmp_path, SHORT)
    assert "other settings, code or inputs" in caplog.text and "starts at 0" in caplog.text
    assert (summary.resumed_at, summary.iterations) == ([], 30) and same_parameters(model, uninterrupted)


def headers(path: Path) -> list[int]:
    """The bytes of an archive outside its members' content: local headers, the directory and its end."""
    whole, content = path.read_bytes(), set()
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            begin = member.header_offset + LOCAL_HEADER.size
            begin += sum(LOCAL_HEADER.unpack(whole[member.header_offset : begin]))
            content.update(range(begin, begin + member.file_size))
    return [i for i in range(len(whole)) if i not in content]


def test_each_of_30_flipped_bits_of_a_resume_state_is_refused_or_without_effect(tmp_path, caplog):
    """Half of them lie in the archive's headers, which no checksum covers."""
    with pytest.raises(EndedError):
        trained(tmp_path, SHORT, EndingViews(recorded_views(), 20))
    path, chance = tmp_path / "resume/state.npz", random.Random(22)
    whole, outside = path.read_bytes(), headers(path)
    places = [chance.choice(outside) if i % 2 else chance.randrange(len(whole)) for i in range(FLIPS)]
    refused = 0
    for place in places:
        altered = bytearray(whole)
        altered[place] ^= 1 << chance.randrange(8)
        path.write_bytes(altered)
        caplog.clear()
        content = resume_state.resumable(path, "of this training")
        if content is None:
            (message,) = caplog.messages
            assert message.startswith(f"{path}: not a file of arrays") and message.endswith("training starts at 0")
            refused += 1
        else:
            checkpoint_file.save(tmp_path / "again.npz", content)
            assert (tmp_path / "again.npz").read_bytes() == whole, f"byte {place} was read otherwise than written"
    assert FLIPS / 2 <= refused < FLIPS, "flips of both kinds"


def test_a_missing_checkpoint_is_named_with_its_rule(tmp_path):
    with pytest.raises(ResultError, match=r"checkpoint\.npz.*'train'"):
        read_checkpoint(tmp_path / "checkpoint.npz")


@pytest.mark.parametrize(
    ("failure", "told"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), r"state\.npz.*cannot be written"),
        (KeyboardInterrupt("by hand"), "by hand"),
    ],
)
def test_a_crash_while_a_checkpoint_is_written_keeps_the_earlier_one(tmp_path, monkeypatch, failure, told):
    path = tmp_path / "state.npz"
    checkpoint_file.save(path, {"step": 1, "means": torch.ones(3)})

    def half(file: Any, *_: Any, **__: Any) -> None:
        file.write(b"half an array")
        raise failure

    monkeypatch.setattr(np.lib.format, "write_array", half)
    with pytest.raises((ResultError, KeyboardInterrupt), match=told):
        checkpoint_file.save(path, {"step": 2})
    assert checkpoint_file.load(path, "train")["step"] == 1
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_a_second_trainer_is_refused_naming_the_first_and_a_killed_one_frees_the_folder(tmp_path):
    """So does one that failed."""

    def assert_refused(process: int | None) -> None:
        refusal = rf"process {process} is still training in .*resume"
        with pytest.raises(TrainingError, match=refusal), resume_state.training_lock(tmp_path / "resume"):
            pass

    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    holder = context.Process(target=hold_the_lock, args=(tmp_path / "resume", there))
    holder.start()
    try:
        assert here.poll(PATIENCE_S) and here.recv() == "held"
        assert_refused(holder.pid)
    finally:
        holder.kill()
        holder.join()
    with pytest.raises(EndedError), resume_state.training_lock(tmp_path / "resume"):
        assert_refused(os.getpid())
        raise EndedError
    with resume_state.training_lock(tmp_path / "resume"):
        assert_refused(os.getpid())


# ---- numbers that are none


BREAKING = GaussianSettings(sh_degree=1, lr_sh0=1e30)
"""Colours leap to 1e29 in the first step, so that the second iteration's squares overflow."""


def test_a_loss_that_is_no_number_stops_the_training_and_keeps_the_last_checkpoint(tmp_path):
    """And nothing that could pass for a result."""
    job = job_of(checkpoint_every=1, log_every=10, gaussians=BREAKING, opacity_reg=0, scale_reg=0)
    with pytest.raises(TrainingError) as error:
        run(tmp_path, job)
    message, folder = str(error.value), tmp_path / "vanilla"
    assert message.startswith("iteration 2: ") and "loss ssim" in message and "gradient of background" in message
    assert "opacity_reg" not in message and "scale_reg" not in message
    assert str(folder / "resume/state.npz") in message
    assert checkpoint_file.load(folder / "resume/state.npz", "train")["step"] == 1
    assert {path.name for path in folder.iterdir()} == {"resume", "tensorboard"}


@pytest.mark.parametrize(("strategy", "log_every"), [("mcmc", 25), ("default", 25)])
def test_a_loss_that_is_not_finite_is_a_training_error_however_rarely_it_is_checked(tmp_path, strategy, log_every):
    """Densification comes between the loss that is no number and the check."""
    settings = settings_of(strategy, checkpoint_every=1000, log_every=log_every, refine_start=0.0, gaussians=BREAKING)
    with pytest.raises(TrainingError, match=r"^iteration 2: .*not finite"):
        trained(tmp_path, settings)


@pytest.mark.parametrize(("strategy", "log_every"), [("mcmc", 25), ("default", 1)])
def test_a_training_without_gaussians_left_says_so(tmp_path, strategy, log_every):
    settings = settings_of(strategy, log_every=log_every, refine_start=0.0, checkpoint_every=1000)
    model = untrained(settings)
    model.parts[0].params["opacities"].data.fill_(-30.0)
    with pytest.raises(TrainingError, match="no Gaussian is left"):
        trained(tmp_path, settings, model=model)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_the_guard_names_the_first_iteration_and_its_terms_alone(value):
    """Also where another iteration watched a term that this one did not."""
    guard, fine, bad = FiniteGuard(CPU), torch.tensor(1.0), torch.tensor(value)
    guard.watch(0, {"loss l1": fine, "loss ssim": fine, "gradient of means": fine})
    guard.check("state.npz")
    guard.watch(6, {"loss l1": fine, "loss ssim": bad, "gradient of means": bad})
    guard.watch(7, {"loss l1": bad, "loss ssim": bad, "gradient of means": bad})
    guard.watch(9, {"loss l1": fine, "loss sky_alpha": bad})
    found = "iteration 7: loss ssim, gradient of means"
    with pytest.raises(TrainingError, match=rf"{found} is not finite; .*state\.npz"):
        guard.check("state.npz")
    with pytest.raises(TrainingError, match=rf"{found} \(tracks a, b\) is not finite; "):
        guard.check("state.npz", lambda: ["a", "b"])


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


def test_a_reset_of_all_opacities_is_no_loss_of_gaussians(tmp_path):
    faintest = DefaultSettings(refine_every=1000, reset_every=10, prune_opacity=1e-3, grow_grad2d=1e3)
    settings = settings_of("default", iterations=25, log_every=1, refine_start=0.0, refine_stop=1.0, default=faintest)
    _, summary = trained(tmp_path, settings)
    assert summary.gaussians == 90


# ---- what it tells


def board_in(folder: Path) -> EventAccumulator:
    board = EventAccumulator(str(folder / "tensorboard"))
    board.Reload()
    return board


def hyperparameters_in(folder: Path) -> dict[str, Any]:
    """The values of the settings that TensorBoard knows, by name."""
    metadata = board_in(folder).SummaryMetadata("_hparams_/session_start_info")
    return dict(HParamsPluginData.FromString(metadata.plugin_data.content).session_start_info.hparams)


def test_tensorboard_holds_every_loss_and_picture_once_also_of_a_resumed_training(tmp_path):
    """It has resumed before an iteration that was logged."""
    settings = settings_of(image_every=20)
    with pytest.raises(EndedError):
        trained(tmp_path, settings, EndingViews(recorded_views(), ENDED_AT))
    trained(tmp_path, settings)
    board = board_in(tmp_path)
    wanted = {"loss/total", "loss/l1", "loss/ssim", "loss/opacity_reg", "loss/scale_reg", "gaussians"}
    assert set(board.Tags()["scalars"]) == wanted
    losses = {name: [event.value for event in board.Scalars(name)] for name in wanted}
    assert [event.step for event in board.Scalars("loss/total")] == [10, 20, 30, 40, 50, 60]
    assert losses["loss/total"][-1] < losses["loss/total"][0]
    parts = [losses[name] for name in wanted - {"loss/total", "gaussians"}]
    np.testing.assert_allclose(losses["loss/total"], np.sum(parts, axis=0), rtol=1e-5)
    assert [event.step for event in board.Images("recorded_and_rendered")] == [20, 40, 60]
    assert {(event.width, event.height) for event in board.Images("recorded_and_rendered")} == {(2 * WIDTH, HEIGHT)}


def test_tensorboards_pictures_show_all_gaussians_also_with_dropout(tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(Monitor, "image", lambda self, step, view, picture: shown.append(picture))
    trained(tmp_path, settings_of(iterations=8, image_every=4, dropout=0.5))
    assert len(shown) == 2
    assert all((picture.shapes.opacities > 0.0).all() and not picture.image.requires_grad for picture in shown)


# ---- its files


def run(folder: Path, job: TrainJob, device: str = "cpu", actors: bool = False) -> TrainingFiles:
    files = files_in(folder / "vanilla")
    inputs = inputs_in(folder, actors)
    run_training(inputs, job, DeviceSettings(kind=device), files, PROVENANCE, "train")
    return files


def test_a_finished_training_leaves_a_checkpoint_a_summary_and_curves(tmp_path):
    """With the terms about surfaces, one of which needs the road of the scene, and curves of training and held-out
    images every eight iterations and after the last of 20."""
    job = job_of(flatness_weight=0.1, road_weight=0.1, psnr_every=8, image_every=15)
    files = run(tmp_path, job)
    assert {path.name for path in files.checkpoint.parent.iterdir()} == {"checkpoint.npz", "train.json", "tensorboard"}
    summary = json.loads(files.summary.read_text())
    content = read_checkpoint(files.checkpoint)
    model = trained_model(content)
    assert content.provenance == summary["provenance"] == PROVENANCE
    assert content.job == job
    assert summary["gaussians"] == len(model) and summary["iterations"] == 20 and summary["random_seed"] == 3
    assert summary["peak_gpu_memory_gb"] is None and summary["resumed_at"] == []
    views = recorded_views()
    assert mean_psnr(model, views) > mean_psnr(untrained(settings_of()), views) + 1.0
    board = board_in(files.checkpoint.parent)
    assert {"loss/flatness", "loss/road"} < set(board.Tags()["scalars"])
    held_out = "psnr/held_out", "psnr/interpolation", "psnr/interpolation/static"
    assert {name for name in board.Tags()["scalars"] if name.startswith("psnr")} == {"psnr/train", *held_out}
    for curve in ("psnr/train", *held_out):
        assert [event.step for event in board.Scalars(curve)] == [8, 16, 20]
    told = hyperparameters_in(files.checkpoint.parent)
    assert (told["parts"].string_value, told["road_weight"].number_value) == ("background", pytest.approx(0.1))
    assert told["gaussians.sh_degree"].number_value == job.train.gaussians.sh_degree
    assert board.Scalars("psnr/train")[-1].value > board.Scalars("psnr/train")[0].value
    assert [event.step for event in board.Images("recorded_and_rendered")] == [15, 20]


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
    ("parts", "sky", "changes", "known"),
    [
        (("background",), "none", {"dynamic_weight": 0.0}, {"lidar"}),
        (("background", "actors"), "none", {"dynamic_weight": 0.1}, {"lidar", "moving"}),
        (("background", "actors"), "none", {"dynamic_weight": 0.1, "sky_bce_weight": 0.1}, {"lidar", "moving", "sky"}),
        (("background",), "cubemap", {}, {"lidar", "moving", "sky"}),
    ],
)
def test_only_what_a_training_asks_for_is_read(tmp_path, parts, sky, changes, known):
    """Masks are read by the training images; of people that move, too, is known that they do."""
    supervision = inputs_in(tmp_path, actors=True).supervision(job_of(parts, sky, **changes))
    by_kind = {name: getattr(supervision, name) for name in ("sky", "moving", "lidar")}
    assert {name for name, images in by_kind.items() if images} == known
    assert all(list(images) == [0, 1, 3, 4] for images in by_kind.values() if images)
    if "moving" in known:
        assert supervision.moving[3][HEIGHT // 2 :].all() and not supervision.moving[3][: HEIGHT // 2].any()
    if "sky" in known:
        np.testing.assert_array_equal(supervision.sky[3], np.eye(HEIGHT, WIDTH, 3, dtype=bool))


def test_where_no_sky_is_known_what_is_below_the_horizon_cannot_be_sky(tmp_path):
    """By night the heuristic finds none: with empty masks the cross entropy would fill the dark sky with Gaussians."""
    inputs = inputs_in(tmp_path, actors=True)
    level = rigid(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
    record = dataclasses.replace(inputs.record, camtoworlds=np.stack([level] * 5))
    dark = dataclasses.replace(inputs, record=record, sky_known=False)
    used = job_of(("background", "actors"), "cubemap", sky_bce_weight=0.1, horizon_weight=0.1, dynamic_weight=0.1)
    assert not inputs.supervision(used).not_sky
    assert not dark.supervision(job_of(sky="cubemap", horizon_weight=0.0)).not_sky
    supervision = dark.supervision(used)
    assert not supervision.sky and supervision.moving and list(supervision.not_sky) == [0, 1, 3, 4]
    for view, i in zip(load_views(record, supervision, CPU), supervision.not_sky, strict=True):
        expected = below_horizon(record.Ks[i], level, (WIDTH, HEIGHT))
        assert view.sky is None and 0 < expected.sum() < expected.size
        np.testing.assert_array_equal(view.not_sky.numpy(), expected)


def test_a_training_holds_no_more_gaussians_than_its_pixels_allow(tmp_path):
    pixels = 4 * WIDTH * HEIGHT
    files = run(tmp_path, job_of(pixels_per_gaussian=pixels / 95, cap_max=1000, iterations=15, refine_start=0.0))
    assert json.loads(files.summary.read_text())["gaussians"] == 95


def test_without_a_gpu_a_training_is_refused_before_it_begins(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(DeviceError, match="device: cpu"):
        run(tmp_path, job_of(), device="auto")
    assert not [path for path in tmp_path.rglob("*.*") if path.name in ("checkpoint.npz", "train.json")]


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_actors_that_all_died_and_a_background_that_no_view_shows_do_not_end_a_training(strategy, tmp_path):
    settings = settings_of(strategy, iterations=12, refine_start=0.0, refine_stop=1.0)
    model = untrained_street(settings)
    with torch.no_grad():
        model.parts[0].params["means"][:, 2] *= -1.0
        model.parts[1].params["opacities"].fill_(-30.0)
    _, summary = trained(tmp_path, settings, model=model)
    assert summary.iterations == 12


def test_actors_alone_can_be_trained(tmp_path):
    settings = settings_of(iterations=6, gaussians=GaussianSettings(sh_degree=3), sh_every=0.3)
    trained(tmp_path, settings, model=SplatModel([untrained_street(settings).parts[1]], None))


# ---- curves of PSNR


@pytest.mark.parametrize("strategy", ["mcmc", pytest.param("default", marks=pytest.mark.slow)])
def test_curves_change_no_trained_parameter(strategy, tmp_path):
    """Bit by bit, with views at times and from places that the training does not have."""
    views, ends = recorded_views(), []
    elsewhere = [dataclasses.replace(v, view=dataclasses.replace(v.view, time=v.view.time + 0.123)) for v in views]
    for every in (0, 3):
        settings = settings_of(strategy, iterations=15, refine_start=0.0, psnr_every=every)
        model, folders = untrained_street(settings), folders_of(tmp_path / str(every), "of this training")
        train(
            model,
            views,
            settings,
            0,
            CPU,
            folders,
            curves=[CurveImage(view, {"psnr/held_out": None}) for view in elsewhere],
        )
        ends.append(model)
        assert ("psnr/held_out" in board_in(tmp_path / str(every)).Tags()["scalars"]) == bool(every)
    assert same_parameters(*ends)


def test_held_out_images_are_read_for_the_curves_alone(tmp_path):
    """The third image is held out; without curves nobody reads it."""
    inputs = inputs_in(tmp_path)
    with_curves = prepare(inputs, job_of(), CPU)
    (held_out,) = (image for image in with_curves.curves if "psnr/held_out" in image.curves)
    assert torch.equal(held_out.view.pixels, recorded_views()[2].pixels)
    own, others = {id(view) for view in with_curves.views}, [it for it in with_curves.curves if it is not held_out]
    assert {id(image.view) for image in others} <= own and id(held_out.view) not in own
    assert [[*image.curves] for image in others] == [["psnr/train"]] * MAX_IMAGES
    (tmp_path / "images/2.png").unlink()
    assert prepare(inputs, job_of(psnr_every=0), CPU).curves == []


def test_a_psnr_is_of_all_pixels_outside_the_ego_vehicle():
    views, model = recorded_views(), untrained(settings_of())
    (psnr,) = curve_psnrs(model, [CurveImage(views[0], {"psnr/train": None})], 1).values()
    assert psnr == pytest.approx(mean_psnr(model, views[:1]), abs=1e-4)
    body = torch.zeros(views[0].pixels.shape[:2], dtype=torch.bool)
    body[HEIGHT // 2 :] = True
    masked = dataclasses.replace(views[0], ego_mask=body)
    with torch.no_grad():
        image = model.render(views[0].view, 1).image.clamp(0.0, 1.0)
    error = (image - views[0].target())[: HEIGHT // 2].square().mean()
    image = CurveImage(masked, {"x": None, "upper": ~body, "none": torch.zeros_like(body)})
    found, expected = curve_psnrs(model, [image], 1), pytest.approx(-10.0 * math.log10(error), abs=1e-4)
    assert found == {"x": expected, "upper": expected}, "a curve without pixels is left out"


def test_a_curve_pools_the_pixels_that_count_of_all_its_images():
    """Static and moving pixels, of two images of one group."""
    views, model, rng = recorded_views()[:2], untrained(settings_of()), np.random.default_rng(0)
    masks = [torch.from_numpy(rng.random((HEIGHT, WIDTH)) < share) for share in (0.2, 0.7)]
    images = [
        CurveImage(view, {"psnr/it": None, "psnr/it/moving": mask, "psnr/it/static": ~mask})
        for view, mask in zip(views, masks, strict=True)
    ]
    errors = [model.render(view.view, 1).image.detach().clamp(0.0, 1.0) - view.target() for view in views]
    pooled = {
        "psnr/it": torch.cat([error.flatten() for error in errors]),
        "psnr/it/moving": torch.cat([error[mask].flatten() for error, mask in zip(errors, masks, strict=True)]),
        "psnr/it/static": torch.cat([error[~mask].flatten() for error, mask in zip(errors, masks, strict=True)]),
    }
    expected = {name: -10.0 * math.log10(error.square().mean()) for name, error in pooled.items()}
    assert curve_psnrs(model, images, 1) == pytest.approx(expected, abs=1e-4)
    assert curve_psnrs(model, [], 1) == {}


def test_tensorboard_knows_the_settings_of_a_training_once(tmp_path):
    told = {"parts": "background", "mcmc": {"cap": 5, "noise": 0.5}, "sky": None, "graphs": True}
    for start in (0, 3):
        with Monitor(tmp_path / "tensorboard", 10, start, "it") as monitor:
            monitor.hyperparameters(told, ["psnr/held_out"])
    found = hyperparameters_in(tmp_path)
    assert found.keys() == {"parts", "mcmc.cap", "mcmc.noise", "sky", "graphs"}
    assert (found["mcmc.cap"].number_value, found["sky"].string_value, found["graphs"].string_value) == (
        5,
        "null",
        "true",
    )
    assert [path.name for path in tmp_path.iterdir()] == ["tensorboard"], "no folder of its own"


def test_few_images_are_spread_over_all():
    assert evenly_spaced([]) == [] and evenly_spaced([7]) == [7] and evenly_spaced([7, 9]) == [7, 9]
    chosen = evenly_spaced(range(100))
    assert len(chosen) == MAX_IMAGES and np.ptp(chosen) == 99


# ---- the mean of parameters over the last iterations


def averages(monkeypatch) -> list[dict[str, torch.Tensor]]:
    """The parameters of a model when each iteration of later trainings ends, before a mean is written."""
    recorded, update = [], ParameterAverage.update

    def recording(average, step, model):
        recorded.append({name: value.detach().clone() for name, value in model.named_parameters()})
        return update(average, step, model)

    monkeypatch.setattr(ParameterAverage, "update", recording)
    return recorded


@pytest.mark.parametrize("strategy", [pytest.param("mcmc", marks=pytest.mark.slow), "default"])
def test_a_training_ends_with_the_mean_of_its_last_parameters(strategy, monkeypatch, tmp_path):
    """Of 40 iterations every fifth of the last 20: densification ends with the 16th. Owners of Gaussians stay, and no
    Gaussian of the mean is outside of the box of its object. The last PSNR is that of this mean, too."""
    recorded, measured, psnrs = averages(monkeypatch), [], TrainingRun.psnrs

    def watching(run):
        measured.append({name: value.detach().clone() for name, value in run.trainer.state.model.named_parameters()})
        return psnrs(run)

    monkeypatch.setattr(TrainingRun, "psnrs", watching)
    settings = settings_of(strategy, iterations=40, refine_stop=0.4, averaged=0.5)
    model, _ = trained(tmp_path, settings, guided_views(), model=untrained_street(settings))
    assert len(recorded) == 40
    last = recorded[20 + AVERAGED_EVERY - 1 :: AVERAGED_EVERY]
    expected = copy.deepcopy(model)
    for name, value in expected.named_parameters():
        if value.is_floating_point():
            value.data.copy_(torch.stack([each[name] for each in last]).mean(dim=0))
        else:
            assert torch.equal(value, recorded[-1][name])
    for part in expected.parts:
        part.confine()
    for value, own in zip(model.parameters(), expected.parameters(), strict=True):
        torch.testing.assert_close(value.detach(), own.detach(), atol=1e-5, rtol=1e-4)
    assert same_as(measured[-1], dict(model.named_parameters())) and not same_as(recorded[-1], measured[-1])


def same_as(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(value, other[name]) for name, value in one.items())


@pytest.mark.parametrize(("share", "refine_stop"), [(0.0, 0.4), (0.5, 1.0)])
def test_there_is_no_mean_where_none_is_wanted_or_densification_never_ends(share, refine_stop, monkeypatch, tmp_path):
    settings = settings_of(iterations=20, averaged=share, refine_stop=refine_stop)
    recorded = averages(monkeypatch)
    model, _ = trained(tmp_path, settings)
    assert same_as(recorded[-1], dict(model.named_parameters()))


@pytest.mark.parametrize(("share", "first"), [(0.1, 6_301), (0.3, 5_832), (1.0, 5_832)])
def test_the_mean_begins_after_the_last_densification(share, first):
    average = ParameterAverage.of(Schedule.of(settings_of(iterations=7_000, refine_stop=0.833, averaged=share), 1))
    assert (average.first, average.last) == (first, 7_000)


def test_a_training_that_ends_within_the_mean_resumes_as_the_same_training(tmp_path):
    settings = settings_of(iterations=30, checkpoint_every=15, refine_stop=0.2, averaged=0.75)
    whole, _ = trained(tmp_path / "whole", settings)
    with pytest.raises(EndedError):
        trained(tmp_path / "it", settings, EndingViews(recorded_views(), 22))
    resumed, summary = trained(tmp_path / "it", settings)
    assert summary.resumed_at == [15]
    assert same_parameters(resumed, whole)


def test_gaussians_in_empty_space_are_faded_in_the_mean_too(monkeypatch, tmp_path):
    """As if a mean had restored all: cameras drove from x = -1 to 1."""

    def opaque(average, step, model):
        if step == average.last:
            model.parts[0].params["opacities"].data.fill_(3.0)
        return step == average.last

    monkeypatch.setattr(ParameterAverage, "update", opaque)
    settings = settings_of(iterations=10, floaters=FloaterSettings(radius=4.5, every=100))
    model, _ = trained(tmp_path, settings, model=untrained(settings))
    opacities, near = model.parts[0].params["opacities"], model.parts[0].params["means"].norm(dim=1) < 4.0
    assert near.any() and (opacities[near] < 0.0).all() and (opacities == 3.0).any()
