"""The named worlds of benchmarks/worlds: they can be generated, and their streets are those of published results."""

import json

import numpy as np
import pytest
from helpers import REPOSITORY
from helpers.demo_worlds import pose_at
from helpers.ground_rectangles import meetings
from helpers.world_digests import (
    DIGESTS,
    PICTURES,
    WORLDS,
    digest,
    job_of_world,
    pictures,
    recorder_of_world,
    shape_digests,
    texture_digests,
)
from nuscenes.nuscenes import NuScenes

from drivesplat.readers.truth import read_truth
from drivesplat.workflow.edits_file import read_edits
from drivesplat.world.generate import make_world, require_free_places

STORED = json.loads(DIGESTS.read_text())
NAMES = {"day", "dense", "lidar", "night", "slope", "six_cameras"}
BY_DEFAULT = {"dense", "slope"}
"""Worlds whose streets `make test` compares: a queue on a straight road, and free traffic in a bend with a slope."""


@pytest.fixture(scope="module", params=WORLDS)
def name(request) -> str:
    return request.param


@pytest.mark.slow
def test_objects_do_not_intersect_and_edits_resolve_and_place_nothing_inside_anything(name):
    recorder, path = recorder_of_world(name), REPOSITORY / f"benchmarks/worlds/edits/{name}.yaml"
    assert meetings(recorder) == []
    assert set(recorder.edits) == (set(read_edits(path)) if path.is_file() else set())
    require_free_places(recorder)
    before, late = {item.name: item for item in recorder.street.objects}, np.array([8.0])
    for edit in recorder.edits:
        variation = recorder.variation(edit)
        after = {item.name: item for item in variation.street.objects}
        changed = before.keys() != after.keys() or any(
            np.abs(pose_at(item, 5.0) - pose_at(before[own], 5.0)).max() > 0.1 for own, item in after.items()
        )
        moved = np.abs(variation.ego_poses(late) - recorder.ego_to_street(late)).max()
        assert changed or moved > 0.1, f"{edit} changes nothing"


def test_a_world_is_what_its_name_in_the_documentation_says():
    assert set(WORLDS) == NAMES == set(STORED["streets"])
    worlds = {name: job_of_world(name).world for name in WORLDS}
    assert {world.width for world in worlds.values()} == {1600}
    assert len({world.random_seed for world in worlds.values()}) == len(worlds)
    assert worlds["night"].night and worlds["night"].wet and not worlds["day"].night
    assert worlds["slope"].bend_deg and worlds["slope"].grade and worlds["slope"].readout_s
    assert worlds["dense"].traffic == "queue" and worlds["dense"].key_frame_hz == 10
    assert worlds["day"].cameras == ("CAM_FRONT",), "the dataset's setting `cameras`"
    assert len(worlds["six_cameras"].cameras) == 5 and "CAM_FRONT_LEFT" not in worlds["six_cameras"].cameras
    assert "CAM_FRONT_LEFT" in worlds["six_cameras"].truth.cameras, "the sixth is held out"


HOW_TO = (
    "have changed, and with them all results on synthetic worlds; if that is meant, run "
    "PYTHONPATH=.:tests python -m helpers.world_digests and measure docs/measured.md anew"
)


@pytest.mark.parametrize(
    "name", [world if world in BY_DEFAULT else pytest.param(world, marks=pytest.mark.slow) for world in WORLDS]
)
def test_streets_are_those_of_the_stored_digests(name):
    assert digest(recorder_of_world(name)) == STORED["streets"][name], f"the streets of {name} {HOW_TO}"


def test_shapes_and_textures_are_those_of_the_stored_digests():
    assert (shape_digests(), texture_digests()) == (STORED["shapes"], STORED["textures"]), f"they {HOW_TO}"


@pytest.mark.parametrize("name", [n if n == "day" else pytest.param(n, marks=pytest.mark.slow) for n in PICTURES])
def test_recordings_are_those_that_are_stored_but_for_rounding(name):
    """Shading, textures, shadows, haze, noise; classes; returns of each beam. Processors differ in pixels at edges."""
    found, stored = pictures(name), STORED["pictures"][name]
    assert found.keys() == stored.keys()
    for kind, tolerance in (("image", 2), ("classes", 5), ("returns", 5), ("ranges", 5), ("intensities", 3)):
        off = np.abs(np.subtract(found[kind], stored[kind]))
        assert np.mean(off <= tolerance) > 0.96, f"{kind} {HOW_TO}"
        assert kind != "image" or off.max() <= 6, HOW_TO


@pytest.mark.slow
def test_the_devkit_loads_a_small_version_of_it(name, tmp_path):
    job = job_of_world(name)
    truth = job.world.truth.model_copy(update={"lidar": False})
    small = {"width": 64, "key_frames": 3, "samples_per_pixel": 1, "truth": truth}
    world = job.world.model_copy(update=small)
    make_world(tmp_path, job.model_copy(update={"world": world}), {"stages": {}}, workers=2)
    tables = NuScenes(job.version, str(tmp_path), verbose=False)
    (scene,) = tables.scene
    assert scene["name"] == f"scene-{name}" and scene["nbr_samples"] == 3
    token = scene["first_sample_token"]
    while token:
        sample = tables.get("sample", token)
        assert set(sample["data"]) == {*world.cameras, "LIDAR_TOP"}
        path, boxes, _ = tables.get_sample_data(sample["data"]["CAM_FRONT"])
        assert path.startswith(str(tmp_path)) and boxes
        token = sample["next"]
    categories = {category["name"] for category in tables.category}
    assert "human.pedestrian.adult" in categories and categories & {"vehicle.car", "vehicle.truck"}
    views = read_truth(tmp_path / "truth/truth.json").views
    assert {view.camera for view in views} == set(truth.cameras)
    assert {view.edit for view in views} == {None, *job.edits}
