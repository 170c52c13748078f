"""parts/: every group of a model as a PLY in its own frame, from which parts.json makes the drive again."""

import json
import logging

import numpy as np
import pytest
import torch
from helpers.hand_made import BLACK, recording_of, round_gaussians
from helpers.hand_made_traffic import FADING, GONE_AT_TIMES, TRAJECTORIES, TURNING, Traffic, own_gaussians, placed
from helpers.records import EMPTY_CHECKPOINT

from drivesplat.export import splat_asset
from drivesplat.export.splat_asset import SplatFiles, export_splat
from drivesplat.export.trained_parts import trained_gaussians, trained_groups
from drivesplat.io.unique_names import unique_names
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.splat_ply import read_splat_ply
from drivesplat.settings.export import SplatJob

DIGESTS = {"settings_sha256": "a" * 64, "code_sha256": "b" * 64, "inputs_sha256": "c" * 64}
PROVENANCE = {**DIGESTS, "stages": {}}
MIDDLE = 2.25
STREET = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]]


def street() -> SplatModel:
    """A static background of three Gaussians, without view dependence, and two vehicles, with."""
    return SplatModel([round_gaussians(STREET, colors=BLACK), Traffic()], None)


def export_all(folder, model, scene, monkeypatch):
    """What the stage writes into `folder` for a model; returns parts.json's content."""
    monkeypatch.setattr(splat_asset, "trained_model", lambda _: model)
    names = ("splat.ply", "cameras.json", "parts/parts.json", "transforms.json")
    files = SplatFiles(*(folder / name for name in names))
    export_splat(files, EMPTY_CHECKPOINT, recording_of(scene).record, scene, SplatJob(), PROVENANCE)
    return json.loads((folder / "parts/parts.json").read_text())


@pytest.fixture(scope="module")
def folder(tmp_path_factory, scene):
    folder = tmp_path_factory.mktemp("street")
    with pytest.MonkeyPatch.context() as monkeypatch:
        export_all(folder, street(), scene, monkeypatch)
    return folder


@pytest.fixture(scope="module")
def parts(folder):
    return {part["name"]: part for part in json.loads((folder / "parts/parts.json").read_text())["parts"]}


def unit(quats: torch.Tensor) -> torch.Tensor:
    """Unit quaternions, each and its negative the same."""
    quats = quats / quats.norm(dim=-1, keepdim=True)
    return quats * torch.sign(quats.gather(1, quats.abs().argmax(dim=1, keepdim=True)))


def assert_same(found: Gaussians, expected: Gaussians, atol: float = 1e-6) -> None:
    torch.testing.assert_close(found.means, expected.means, rtol=0, atol=atol)
    torch.testing.assert_close(unit(found.quats), unit(expected.quats), rtol=0, atol=1e-5)
    torch.testing.assert_close(found.scales, expected.scales, rtol=1e-5, atol=0)
    torch.testing.assert_close(found.opacities, expected.opacities, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(found.sh, expected.sh, rtol=0, atol=1e-5)


def test_objects_are_in_their_own_frame_with_the_colours_of_the_middle_image(folder, parts):
    for track_id in TRAJECTORIES:
        found = read_splat_ply(folder / "parts" / parts[track_id]["file"])
        assert_same(found, own_gaussians(track_id, MIDDLE))
    background = read_splat_ply(folder / "parts/background.ply")
    np.testing.assert_allclose(background.means, STREET)
    assert background.sh_degree == 0


def test_samples_are_dense_while_an_object_is_present_and_absent_otherwise(parts):
    for track_id, trajectory in TRAJECTORIES.items():
        motion = parts[track_id]["motion"]
        seconds = np.array(motion["seconds"])
        assert np.diff(seconds).min() > 0.0
        expected = [[trajectory.times[a] - 0.25, trajectory.times[b] + 0.25] for a, b in trajectory.runs]
        np.testing.assert_allclose(motion["present"], expected, atol=1e-9)
        held = [seconds[(seconds >= low - 1e-6) & (seconds <= high + 1e-6)] for low, high in expected]
        assert sum(map(len, held)) == len(seconds)
        for inside, (low, high) in zip(held, expected, strict=True):
            np.testing.assert_allclose([inside[0], inside[-1]], [low, high], atol=1e-6)
            assert np.diff(inside).max() < 1 / 30 + 2e-6


def test_the_groups_compose_the_drive_at_every_image(folder, parts, scene):
    """Files and poses of parts.json alone give what the model shows, in the colours of the middle image."""
    first, model = min(frame.timestamp for frame in scene.frames), street()
    for frame in scene.frames:
        seconds = (frame.timestamp - first) * 1e-6
        world = model.at(seconds)
        start = len(STREET)
        for track_id in TRAJECTORIES:
            expected, start = world[slice(start, start + 12)], start + 12
            motion = parts[track_id]["motion"]
            if frame.timestamp not in motion["timestamps"]:
                assert (expected.opacities == 0).all()
                continue
            pose = np.array(motion["object_to_world"][motion["timestamps"].index(frame.timestamp)])
            found = placed(read_splat_ply(folder / "parts" / parts[track_id]["file"]), pose)
            expected.sh0[:, 0] += FADING * (MIDDLE - seconds)
            assert_same(found, expected, atol=2e-5)


def test_splat_ply_holds_all_groups_present_at_the_middle_image(folder):
    found = read_splat_ply(folder / "splat.ply")
    present = placed(own_gaussians(TURNING, MIDDLE), TRAJECTORIES[TURNING].pose(MIDDLE))
    assert len(found) == len(STREET) + len(present), "the absent vehicle is not there, invisible or not"
    np.testing.assert_allclose(found.means[:3], STREET)
    assert_same(found[slice(3, None)], present, atol=1e-5)
    assert not found.sh[:3, 1:].any()


def test_vanilla_is_one_group_equal_to_splat_ply(tmp_path, tiny_scene, monkeypatch):
    """A transparent static Gaussian is no absent object."""
    model = SplatModel([round_gaussians(STREET, opacities=[0.0, 0.5, 0.9])], None)
    (part,) = export_all(tmp_path, model, tiny_scene, monkeypatch)["parts"]
    assert (part["file"], part["frame"], part["motion"]) == ("background.ply", "world", None)
    found = read_splat_ply(tmp_path / "splat.ply")
    assert len(found) == 3
    assert_same(read_splat_ply(tmp_path / "parts/background.ply"), found)
    assert unique_names(["a", "A", "a_2"], str) == {"a": "a", "A": "A_2", "a_2": "a_2_2"}
    assert unique_names(["camera", "b"], str, taken=["Camera"]) == {"camera": "camera_2", "b": "b"}


def test_gaussians_with_nan_are_dropped_in_every_export(tiny_scene, monkeypatch, caplog):
    def broken(track_id: str, time: float) -> Gaussians:
        own = own_gaussians(track_id, time)
        own.scales[4, 1] = torch.inf
        own.opacities[5] = torch.nan
        return own

    monkeypatch.setattr("helpers.hand_made_traffic.own_gaussians", broken)
    with caplog.at_level(logging.WARNING):
        together = trained_gaussians(street(), tiny_scene)
        groups = trained_groups(street(), tiny_scene, np.array([], dtype=np.int64))
    assert len(together) == 3 + 10
    counts = {name: len(group.gaussians) for name, group in groups.items()}
    assert counts == {"background": 3, TURNING: 10, GONE_AT_TIMES: 10}
    assert f"{TURNING}: 2 of 12 Gaussians contain NaN or Inf and are dropped" in caplog.text
