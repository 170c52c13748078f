"""masks/ of other tracks than the annotated ones: other regions, the same sky, classes and ego vehicle."""

import dataclasses

import numpy as np
import pytest

from drivesplat.errors import ResultError
from drivesplat.io.storage import write_json
from drivesplat.preprocess.masks import make_masks, relabelled_masks
from drivesplat.scene.ego_mask import EgoMask
from drivesplat.scene.masks import mask_name, read_labels, read_sky_mask
from drivesplat.scene.regions import LABELS, label_image
from drivesplat.scene.scene import Track
from drivesplat.settings.masks import MaskJob, RegionJob

SIZE = (96, 54)
JOB = RegionJob.model_validate({"images": {"width": None}})
BONNET = EgoMask({"CAM_FRONT": (((0.0, 0.9), (1.0, 0.9), (1.0, 1.0), (0.0, 1.0)),)}, {"CAM_FRONT": "polygons"})


@pytest.fixture
def shared(tiny_scene, tmp_path):
    """The folder of masks by annotated tracks."""
    job = MaskJob.model_validate({"masks": {}, "holdout": {}, "images": {"width": None}})
    record = make_masks(tiny_scene, job, tmp_path / "masks", BONNET)
    write_json(tmp_path / "masks/masks.json", vars(record))
    return tmp_path / "masks"


def moved(track: Track) -> Track:
    """The track three metres to the left, of unknown visibility, as discovered ones are."""
    poses = track.object_to_world.copy()
    poses[:, 1, 3] += 3.0
    return dataclasses.replace(track, id="found_0001", object_to_world=poses, visibility=0 * track.visibility)


def test_regions_are_those_of_the_tracks_and_all_else_is_shared(tiny_scene, shared, tmp_path):
    car = next(track for track in tiny_scene.tracks if track.category == "vehicle.car")
    found = dataclasses.replace(tiny_scene, tracks=(moved(car),))
    record = relabelled_masks(found, JOB, shared, tmp_path / "discovered/masks")
    assert (record.regions, record.visibility, record.own_car) == ("boxes", "estimated", {"CAM_FRONT": "polygons"})
    for frame in tiny_scene.frames:
        at = frame.camera, frame.timestamp, SIZE
        labels, before = (read_labels(folder, *at) for folder in (tmp_path / "discovered/masks", shared))
        body = before == LABELS["own_car"]
        assert body.any() and (labels[body] == LABELS["own_car"]).all()
        np.testing.assert_array_equal(labels[~body], label_image(found, frame, SIZE)[~body])
        assert (labels != before).any()
        np.testing.assert_array_equal(*(read_sky_mask(f, *at) for f in (tmp_path / "discovered/masks", shared)))


def test_without_tracks_everything_is_static(tiny_scene, shared, tmp_path):
    record = relabelled_masks(dataclasses.replace(tiny_scene, tracks=()), JOB, shared, tmp_path / "unlabelled/masks")
    frame = tiny_scene.frames[0]
    labels = read_labels(tmp_path / "unlabelled/masks", frame.camera, frame.timestamp, SIZE)
    assert set(np.unique(labels)) == {LABELS["static"], LABELS["own_car"]} and record.visibility is None


def test_sky_masks_take_no_more_room(tiny_scene, shared, tmp_path):
    folder, frame = tmp_path / "discovered/masks", tiny_scene.frames[0]
    relabelled_masks(tiny_scene, JOB, shared, folder)
    name = mask_name("sky", frame.camera, frame.timestamp)
    assert (folder / name).samefile(shared / name)
    regions = mask_name("regions", frame.camera, frame.timestamp)
    assert not (folder / regions).samefile(shared / regions)


def test_a_damaged_mask_is_named_with_the_rule_that_rebuilds_it(tiny_scene, shared, tmp_path):
    frame = tiny_scene.frames[0]
    (shared / mask_name("regions", frame.camera, frame.timestamp)).write_bytes(b"no image")
    with pytest.raises(ResultError, match="the rule 'masks' rebuilds it"):
        relabelled_masks(tiny_scene, JOB, shared, tmp_path / "discovered/masks")
