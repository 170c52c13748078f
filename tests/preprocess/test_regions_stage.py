"""masks/ of other tracks than the annotated ones: other regions, the same sky, classes and ego vehicle."""

import dataclasses

import numpy as np
import pytest

from drivesplat.errors import ResultError
from drivesplat.io.storage import write_json
from drivesplat.preprocess.masks import make_masks, relabelled_masks
from drivesplat.scene.ego_mask import EgoMask
from drivesplat.scene.masks import mask_name, read_labels
from drivesplat.scene.regions import LABELS, label_image
from drivesplat.scene.scene import Scene, Track
from drivesplat.settings.masks import MaskJob, RegionJob

SIZE = (96, 54)
JOB = RegionJob.model_validate({"images": {"width": None}})
BONNET = EgoMask({"CAM_FRONT": (((0.0, 0.9), (1.0, 0.9), (1.0, 1.0), (0.0, 1.0)),)}, {"CAM_FRONT": "polygons"})


@pytest.fixture
def scene(tiny_scene) -> Scene:
    return dataclasses.replace(tiny_scene, frames=tiny_scene.frames[:4])


@pytest.fixture
def shared(scene, tmp_path):
    """The folder of masks by annotated tracks."""
    job = MaskJob.model_validate({"masks": {}, "holdout": {}, "images": {"width": None}})
    record = make_masks(scene, job, tmp_path / "masks", BONNET)
    write_json(tmp_path / "masks/masks.json", vars(record))
    return tmp_path / "masks"


def test_regions_are_those_of_the_tracks_and_all_else_is_shared(scene, shared, tmp_path):
    """Sky masks take no more room."""
    car = next(track for track in scene.tracks if track.category == "vehicle.car")
    found, folder = dataclasses.replace(scene, tracks=(moved(car),)), tmp_path / "discovered/masks"
    record = relabelled_masks(found, JOB, shared, folder)
    assert (record.regions, record.visibility, record.own_car) == ("boxes", "estimated", {"CAM_FRONT": "polygons"})
    for frame in scene.frames:
        at = frame.camera, frame.timestamp, SIZE
        labels, before = (read_labels(root, *at) for root in (folder, shared))
        body = before == LABELS["own_car"]
        assert body.any() and (labels[body] == LABELS["own_car"]).all()
        np.testing.assert_array_equal(labels[~body], label_image(found, frame, SIZE)[~body])
        assert (labels != before).any()
        for kind, same in (("sky", True), ("regions", False)):
            name = mask_name(kind, *at[:2])
            assert (folder / name).samefile(shared / name) is same


def test_without_tracks_everything_is_static_and_a_damaged_mask_is_named(scene, shared, tmp_path):
    folder, frame = tmp_path / "unlabelled/masks", scene.frames[0]
    record = relabelled_masks(dataclasses.replace(scene, tracks=()), JOB, shared, folder)
    labels = read_labels(folder, frame.camera, frame.timestamp, SIZE)
    assert set(np.unique(labels)) == {LABELS["static"], LABELS["own_car"]} and record.visibility is None
    (shared / mask_name("regions", frame.camera, frame.timestamp)).write_bytes(b"no image")
    with pytest.raises(ResultError, match="the rule 'masks' rebuilds it"):
        relabelled_masks(scene, JOB, shared, tmp_path / "discovered/masks")


def moved(track: Track) -> Track:
    """The track three metres to the left, of unknown visibility, as discovered ones are."""
    poses = track.object_to_world.copy()
    poses[:, 1, 3] += 3.0
    return dataclasses.replace(track, id="found_0001", object_to_world=poses, visibility=0 * track.visibility)
