"""What the ego vehicle's body hides teaches a training nothing: from outlines to what is, and what is not, learned."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.rig_drives import rig_drive, true_body
from helpers.trainings import (
    CPU,
    HEIGHT,
    PROVENANCE,
    WIDTH,
    EndedError,
    files_in,
    inputs_in,
    job_of,
    parser_record,
    recorded_views,
    settings_of,
    trained,
)

from drivesplat.io.storage import write_json
from drivesplat.lidar.depth_record import PixelDepths
from drivesplat.model.checkpoint import read_checkpoint, trained_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import view_of
from drivesplat.preprocess.ego_mask import ego_mask_record
from drivesplat.preprocess.lidar_seed import seed_points
from drivesplat.preprocess.masks import make_masks
from drivesplat.preprocess.parser import training_record
from drivesplat.scene.ego_mask import read_ego_mask
from drivesplat.scene.training_record import write_training_record
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.images import HoldoutSettings, ImageSettings, ParserJob
from drivesplat.settings.lidar_seed import LidarSeedSettings, SeedJob
from drivesplat.settings.masks import EgoMaskJob, EgoMaskSearch, MaskJob, MaskSettings
from drivesplat.settings.train import TrainJob
from drivesplat.training import stage
from drivesplat.training.stage import TrainingInputs, read_inputs, run_training
from drivesplat.training.views import Supervision, TrainingView, load_views

pytestmark = pytest.mark.usefixtures("one_thread")

BODY = (230, 20, 230)
CORNER = np.zeros((HEIGHT, WIDTH), dtype=bool)
CORNER[HEIGHT // 2 :, : WIDTH // 2] = True


def views_with_a_body(masked: bool) -> list[TrainingView]:
    """Cameras in a row, each with something magenta before its lower left quarter; what that hides others see."""
    ego_mask = torch.from_numpy(CORNER)
    views = []
    for view in recorded_views(8):
        pixels = torch.where(ego_mask[..., None], torch.tensor(BODY, dtype=torch.uint8), view.pixels)
        views.append(dataclasses.replace(view, pixels=pixels, ego_mask=ego_mask if masked else None))
    return views


@torch.no_grad()
def error_behind(model: SplatModel, like: str) -> float:
    """The mean difference of what a model shows in the body's pixels from the body, or from what it hides."""
    shown = torch.stack([model.render(view.view, 1).image[CORNER] for view in recorded_views(8)])
    hidden = torch.stack([view.target()[CORNER] for view in recorded_views(8)])
    expected = hidden if like == "hidden" else torch.tensor(BODY) / 255.0
    return float((shown - expected).abs().mean())


def test_a_body_before_the_camera_is_not_learned_and_what_it_hides_is(tmp_path):
    settings = settings_of(iterations=60)
    with_mask, without = (
        trained(tmp_path / str(masked), settings, views_with_a_body(masked))[0] for masked in (True, False)
    )
    assert error_behind(without, "body") < 0.25 < 0.4 < error_behind(with_mask, "body")
    assert error_behind(with_mask, "hidden") < 0.7 * error_behind(without, "hidden")


# ---- how a training comes to know


def test_images_of_a_camera_share_the_mask_of_the_body_and_have_no_depth_there(tmp_path):
    depth = PixelDepths(np.array([2, 20], np.int32), np.array([3, 4], np.int32), np.array([5.0, 6.0]))
    none = np.zeros((HEIGHT, WIDTH), dtype=bool)
    supervision = Supervision({}, {}, dict.fromkeys(range(5), depth), ego_mask={0: CORNER, 1: CORNER.copy(), 3: none})
    first, second, empty, unknown = load_views(parser_record(tmp_path, recorded_views()), supervision, CPU)
    assert first.ego_mask.data_ptr() == second.ego_mask.data_ptr() and first.ego_mask.dtype == torch.bool
    np.testing.assert_array_equal(first.ego_mask.numpy(), CORNER)
    assert empty.ego_mask is None and unknown.ego_mask is None, "a mask without pixels costs nothing"
    assert first.lidar.depth.tolist() == [5.0] and unknown.lidar.depth.tolist() == [5.0, 6.0]


def views_given(monkeypatch, folder: Path, inputs: TrainingInputs, job: TrainJob) -> list[TrainingView]:
    """The views with which a training begins; it ends there."""
    given: list[TrainingView] = []

    def begin(model: SplatModel, views: list[TrainingView], *rest: Any, **named: Any) -> None:
        given.extend(views)
        raise EndedError

    monkeypatch.setattr(stage, "train", begin)
    with pytest.raises(EndedError):
        run_training(inputs, job, DeviceSettings(kind="cpu"), files_in(folder / "it"), PROVENANCE, "train")
    return given


def test_the_device_holds_sky_masks_where_a_loss_looks_at_them(tmp_path, monkeypatch):
    inputs, looks = inputs_in(tmp_path, actors=True), {"sky_bce_weight": 0.1}
    for sky, changes in (("cubemap", {}), ("mask", {}), ("cubemap", looks), ("none", looks)):
        job = job_of(sky=sky, **changes)
        assert inputs.supervision(job).sky
        views = views_given(monkeypatch, tmp_path, inputs, job)
        assert [view.sky is not None for view in views] == [(sky, changes) != ("cubemap", {})] * 4


def test_only_cameras_that_see_the_body_are_asked_for_it(tmp_path):
    inputs = inputs_in(tmp_path, actors=True)
    assert inputs.supervision(job_of()).ego_mask == {}
    asked = dataclasses.replace(inputs, cameras_with_ego=frozenset({"CAM_FRONT"})).supervision(job_of()).ego_mask
    assert list(asked) == [0, 1, 3, 4] and not any(mask.any() for mask in asked.values())


# ---- all of it


@pytest.fixture(scope="module")
def prepared(tmp_path_factory) -> Path:
    """A drive whose CAM_BACK sees the ego vehicle, through all stages before the training."""
    folder = tmp_path_factory.mktemp("prepared")
    scene, images = rig_drive(folder, ["CAM_FRONT", "CAM_BACK"], own_car=True), ImageSettings()
    holdout = HoldoutSettings(every_nth=6, offset=3, last_block=0)
    search = EgoMaskSearch(cameras=("CAM_BACK",), holdout=holdout, own_car_radius=2.5)
    record = ego_mask_record(scene, EgoMaskJob(polygons={}, search=search))
    write_json(folder / "own_car.json", {**record, "provenance": {"made": "own_car"}})
    ego_mask, _ = read_ego_mask(folder / "own_car.json")
    made = make_masks(scene, MaskJob(masks=MaskSettings(), holdout=holdout, images=images), folder / "masks", ego_mask)
    write_json(folder / "masks/masks.json", vars(made))
    settings = LidarSeedSettings(max_points=2000, far_points=500)
    seed = seed_points(scene, SeedJob(lidar_seed=settings, holdout=holdout, images=images, random_seed=0), ego_mask)
    record = training_record(scene, seed, ParserJob(holdout=holdout, images=images))
    write_training_record(folder / "parser.npz", record)
    return folder


@pytest.mark.slow
def test_a_body_that_was_found_reaches_the_training_of_its_camera(prepared, monkeypatch, tmp_path):
    inputs, _ = read_inputs(str(prepared / "parser.npz"), [str(prepared / "masks/masks.json")], [], [], [])
    assert inputs.cameras_with_ego == {"CAM_BACK"}
    assert json.loads((prepared / "masks/masks.json").read_text())["own_car"] == {"CAM_BACK": "images"}
    job = job_of(sky="mask", iterations=3, checkpoint_every=10)
    with monkeypatch.context() as patched:
        views = views_given(patched, tmp_path, inputs, job)
    true = true_body("CAM_BACK")
    for view in views:
        assert (view.ego_mask is not None) == (view.view.camera == "CAM_BACK")
        if view.ego_mask is not None:
            assert view.ego_mask.numpy()[true].mean() > 0.9 and not view.sky[view.ego_mask].any()
    assert len({view.ego_mask.data_ptr() for view in views if view.ego_mask is not None}) == 1
    files = files_in(tmp_path / "trained")
    run_training(inputs, job, DeviceSettings(kind="cpu"), files, PROVENANCE, "train")
    model = trained_model(read_checkpoint(files.checkpoint))
    with torch.no_grad():
        assert torch.isfinite(model.render(view_of(inputs.record, 0, CPU)).image).all()
