"""Gaussians far away: none is left in an export, and no training view changes by more than a step of 8 bits, or the
rule says so."""

import logging

import numpy as np
import pytest
import torch
from helpers import hand_made_street
from helpers.hand_made import Own, looking_at, recording_of, round_gaussians
from pxr import Usd, UsdGeom

from drivesplat.errors import ResultError
from drivesplat.export.far_gaussians import MAX_CHANGE, find_far, read_far, within_reach
from drivesplat.export.splat_asset import SplatFiles, export_splat
from drivesplat.export.usd import export_usd
from drivesplat.io.array_file import write_arrays
from drivesplat.model.checkpoint import TrainedCheckpoint, trained_model
from drivesplat.model.reach import reach_of
from drivesplat.model.sky import ConstantSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.splat_ply import read_splat_ply
from drivesplat.model.view import View
from drivesplat.settings.export import ExportJob, SplatJob
from drivesplat.settings.train import TrainSettings

DIGESTS = {"settings_sha256": "a" * 64, "code_sha256": "b" * 64, "inputs_sha256": "c" * 64}
PROVENANCE = {**DIGESTS, "stages": {}, "inputs": {}}
LIMIT = 1000.0
RED, BLUE, SKY = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.3, 0.5, 0.7)


def views(apart: float = 2.0) -> list[View]:
    """Five cameras that drive along x and look ahead."""
    return [looking_at([x + 10.0, 0.0, 1.0], [x, 0.0, 1.0], time=0.5 * i) for i, x in enumerate(apart * np.arange(5.0))]


def near() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Places, sizes and opacities of Gaussians within 40 m of the cameras."""
    rng = np.random.default_rng(0)
    return rng.uniform([15, -8, -3], [40, 8, 5], (60, 3)), rng.uniform(0.2, 1.0, 60), rng.uniform(0.3, 0.95, 60)


def checkpoint_of(places, sizes, opacities, colors=RED) -> TrainedCheckpoint:
    """A checkpoint of the near Gaussians, blue ones, and of others behind a sky."""
    near_places, near_sizes, near_opacities = near()
    places = np.asarray(places, dtype=float).reshape(-1, 3)
    part = round_gaussians(
        np.concatenate([near_places, places]),
        np.concatenate([near_sizes, np.broadcast_to(sizes, len(places))]),
        np.concatenate([near_opacities, np.broadcast_to(opacities, len(places))]),
        np.concatenate([np.tile(BLUE, (len(near_places), 1)), np.broadcast_to(colors, places.shape)]),
    )
    return hand_made_street.checkpoint_of(SplatModel([part], ConstantSky(torch.tensor(SKY), 1e-2)), TrainSettings())


def disc_and_scattered() -> TrainedCheckpoint:
    """A red disc of two degrees, 80 km ahead, and 40 faint Gaussians 1.2 to 90 km away in all directions."""
    directions = np.random.default_rng(1).normal(size=(40, 3))
    directions *= (np.geomspace(1.2e3, 9e4, 40) / np.linalg.norm(directions, axis=1))[:, None]
    places = np.concatenate([[[8e4, 0.0, 1.0]], directions])
    return checkpoint_of(places, sizes=[3e3] + 40 * [0.5], opacities=[0.9] + 40 * [0.003])


def images(checkpoint: TrainedCheckpoint, seen: list[View]) -> torch.Tensor:
    model = trained_model(checkpoint)
    with torch.no_grad():
        return torch.stack([model.render(view).image.clamp(0, 1) for view in seen])


def farthest(checkpoint: TrainedCheckpoint) -> float:
    return float(checkpoint.model["parts.0.params.means"].double().norm(dim=1).max())


def found(checkpoint: TrainedCheckpoint, seen: list[View]):
    return find_far(trained_model(checkpoint), seen, LIMIT, PROVENANCE)


def test_those_that_no_view_shows_are_left_out_and_visible_ones_seen_in_the_same_place_from_within_the_limit():
    """The disc covers sky: without it views would change by far more than 1/255. Cameras in a row towards it see it
    without parallax."""
    checkpoint = disc_and_scattered()
    far = found(checkpoint, views())
    assert farthest(checkpoint) == pytest.approx(9e4, rel=1e-5) and far.views == 5
    assert far.moved.tolist() == [60] and far.removed.tolist() == list(range(61, 101))
    bounded = within_reach(checkpoint, far)
    assert 0.85 * LIMIT < farthest(bounded) <= LIMIT
    for name, values in bounded.model.items():
        kept = checkpoint.model[name]
        assert torch.equal(values[:60], kept[:60]) and len(values) == (61 if name.startswith("parts") else len(kept))
    before, after = images(checkpoint, views()), images(bounded, views())
    assert float((before[..., 0] - before[..., 2]).max()) > 0.3, "the disc is in the picture"
    assert float((after - before).abs().max()) == pytest.approx(far.largest_change, abs=1e-6)
    assert far.largest_change <= MAX_CHANGE


def test_a_bound_that_cannot_be_kept_is_reported_with_the_change(caplog):
    """Cameras 100 m apart, across the line of sight, see a disc at 80 km elsewhere than one at 1 km."""
    aside = [looking_at([50.0, y, 1.0], [0.0, y, 1.0], time=0.5 * i) for i, y in enumerate((-50.0, 50.0))]
    checkpoint = checkpoint_of([[8e4, 0.0, 1.0]], sizes=3e3, opacities=0.9)
    with caplog.at_level(logging.WARNING):
        far = found(checkpoint, aside)
    bounded = within_reach(checkpoint, far)
    assert farthest(bounded) <= LIMIT
    change = float((images(bounded, aside) - images(checkpoint, aside)).abs().max())
    assert change == pytest.approx(far.largest_change, abs=1e-6) and change > MAX_CHANGE
    (message,) = caplog.messages
    assert f"a change of {255 * change:.2f}/255 at most" in message and "1 of 61 Gaussians" in message


def test_a_long_drive_keeps_what_is_near_its_cameras():
    beside, apart = (torch.stack([view.camera_to_world[:3, 3] for view in views(step)]) for step in (2.0, 500.0))
    assert reach_of(beside, LIMIT) == LIMIT
    assert reach_of(apart, LIMIT) == pytest.approx(2500.0, abs=1e-3)


def test_far_gaussians_of_objects_are_left_out_and_those_that_are_not_finite_left_to_the_exports():
    """Positions of an object are those in its box: nothing of it is a kilometre away."""
    astray = Own(round_gaussians([[5.0, 0.0, 0.0], [5e3, 0.0, 0.0]]), "car")
    far = find_far(SplatModel([round_gaussians(near()[0]), astray], None), views(), LIMIT, PROVENANCE)
    assert far.removed.tolist() == [61] and len(far.moved) == 0
    broken = checkpoint_of([[torch.nan, 0.0, 0.0], [torch.inf, 0.0, 0.0]], sizes=0.5, opacities=0.5)
    far = found(broken, views())
    assert len(far.removed) == len(far.moved) == 0


def test_the_record_is_read_back_and_a_damaged_one_refused(tmp_path):
    far = found(checkpoint_of([[8e4, 0.0, 1.0]], sizes=3e3, opacities=0.9), views())
    write_arrays(tmp_path / "far.npz", far)
    again = read_far(tmp_path / "far.npz")
    for name, value in vars(far).items():
        np.testing.assert_array_equal(getattr(again, name), value)
    (tmp_path / "far.npz").write_bytes((tmp_path / "far.npz").read_bytes()[:-30])
    with pytest.raises(ResultError, match=r"far\.npz.*'far_gaussians'"):
        read_far(tmp_path / "far.npz")


def test_no_export_holds_one_and_the_extent_follows(tmp_path, tiny_scene):
    checkpoint, record = disc_and_scattered(), recording_of(tiny_scene).record
    bounded = within_reach(checkpoint, found(checkpoint, views()))
    names = ("splat.ply", "cameras.json", "parts/parts.json", "transforms.json")
    files = SplatFiles(*(tmp_path / name for name in names))
    export_splat(files, bounded, record, tiny_scene, SplatJob(), PROVENANCE)
    job = ExportJob(eval_camera="CAM_FRONT", gaussians=99)
    export_usd(tmp_path / "scene.usdz", bounded, tiny_scene, job, PROVENANCE)
    for path in (files.splat, files.parts.with_name("background.ply")):
        distances = read_splat_ply(path).means.norm(dim=1)
        assert len(distances) == 61 and float(distances.max()) <= LIMIT
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdz"))
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_]).ComputeWorldBound(stage.GetDefaultPrim())
    corners = np.array([*box.ComputeAlignedRange().GetMin(), *box.ComputeAlignedRange().GetMax()])
    assert np.abs(corners).max() < 1.2 * LIMIT
