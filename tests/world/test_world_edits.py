"""Edits of a synthetic world: its own objects stand where the steps of the edit say, all others stay."""

import numpy as np
import pytest
from helpers.demo_worlds import FRONT, LIDAR, edit_of, named, names_of, pose_at, recorder_of, world_of

from drivesplat.errors import ConfigError
from drivesplat.settings.edit import Recolour
from drivesplat.settings.world import WorldDonor
from drivesplat.trajectories.edited_actors import color_matrix
from drivesplat.world.generate import require_free_places
from drivesplat.world.optics.imaging import to_bytes
from drivesplat.world.recorder import Recorder, Viewpoint
from drivesplat.world.street.objects import EGO_BODY
from drivesplat.world.tokens import instance_token

FILM_START = -0.0355
"""Seconds of the first image after the first key frame: the zero of an edit's seconds."""
TIMES = np.linspace(0.0, 9.4, 48)
AHEAD, ONCOMING = (instance_token("demo", f"vehicle {i}") for i in (0, 1))
EDITS = {
    "removed": edit_of({"remove": {"track": ONCOMING}}),
    "aside": edit_of({"shift": {"track": AHEAD, "lateral": 1.5}}),
    "further": edit_of({"shift": {"track": AHEAD, "longitudinal": 4.0}}),
    "turned": edit_of({"shift": {"track": ONCOMING, "yaw": 30.0}}),
    "copied": edit_of({"duplicate": {"track": ONCOMING, "as": "twin", "longitudinal": -12.0, "lateral": 0.5}}),
    "late": edit_of({"duplicate": {"track": ONCOMING, "as": "twin", "delay": 2.0}}),
    "placed": edit_of({"place": {"track": ONCOMING, "as": "new", "path": [[0.0, 60.0, 3.5], [10.0, 10.0, 3.5]]}}),
    "stopped": edit_of({"stop": {"track": AHEAD, "at": 4.0, "duration": 0.0}}),
    "larger": edit_of({"rescale": {"track": AHEAD, "factor": 1.4}}),
    "painted": edit_of({"recolour": {"track": AHEAD, "hue": 120.0, "value": 0.9}}),
    "ego aside": edit_of({"ego": {"lateral": 1.0}}),
    "ego slower": edit_of({"ego": {"speed": 0.5}}),
    "ego later": edit_of({"ego": {"lateral": 2.0, "start": 4.0, "duration": 2.0}}),
}
ALTERED = {"removed": {"vehicle 1"}, "aside": {"vehicle 0"}, "further": {"vehicle 0"}, "turned": {"vehicle 1"},
           "copied": {"twin"}, "late": {"twin"}, "placed": {"new"}, "stopped": {"vehicle 0"},
           "larger": {"vehicle 0"}, "painted": {"vehicle 0"}}  # fmt: skip


@pytest.fixture(scope="module")
def recorder() -> Recorder:
    return recorder_of(EDITS, cyclists=1, lidar={"ego_returns": True})


def poses(recorder: Recorder, name: str, edit: str | None = None) -> np.ndarray:
    return named(recorder, name, edit).poses(TIMES)


def test_objects_that_no_step_names_are_the_very_same(recorder):
    before = {item.name: item for item in recorder.objects if item.name != EGO_BODY}
    for edit in EDITS:
        after = {item.name: item for item in recorder.variation(edit).street.objects if item.name != EGO_BODY}
        assert {name for name in before | after if before.get(name) is not after.get(name)} == ALTERED.get(edit, set())
    assert "vehicle 1" not in names_of(recorder, "removed")
    assert recorder.variation(None).street.objects == recorder.objects


def test_shifted_turned_rescaled_and_stopped_vehicles_stand_where_the_step_says(recorder):
    before, oncoming = poses(recorder, "vehicle 0"), poses(recorder, "vehicle 1")
    for edit, expected in (("aside", [0.0, 1.5, 0.0]), ("further", [4.0, 0.0, 0.0])):
        moved = poses(recorder, "vehicle 0", edit)[:, :3, 3] - before[:, :3, 3]
        in_vehicle = np.einsum("nji,nj->ni", before[:, :3, :3], moved)
        np.testing.assert_allclose(in_vehicle, np.tile(expected, (len(TIMES), 1)), atol=0.03)
    turned = poses(recorder, "vehicle 1", "turned")
    np.testing.assert_allclose(turned[:, :3, 3], oncoming[:, :3, 3], atol=0.002)
    turn = np.swapaxes(oncoming[:, :3, :3], 1, 2) @ turned[:, :3, :3]
    np.testing.assert_allclose(np.degrees(np.arctan2(turn[:, 1, 0], turn[:, 0, 0])), 30.0, atol=0.02)
    larger, item = named(recorder, "vehicle 0", "larger"), named(recorder, "vehicle 0")
    np.testing.assert_allclose(larger.size, 1.4 * item.size)
    np.testing.assert_allclose(larger.poses(TIMES), before, atol=5e-3)
    at = pose_at(larger, 3.0)
    lowest = (larger.body.pieces[0].vertices @ at[:3, :3].T + at[:3, 3])[:, 2].min()
    assert lowest == pytest.approx(0.0, abs=5e-3), "it stays on the ground"
    stopped, at = poses(recorder, "vehicle 0", "stopped")[TIMES > 4.0], pose_at(item, 4.0 + FILM_START)
    np.testing.assert_allclose(stopped, np.broadcast_to(at, stopped.shape), atol=4e-3)


def test_duplicates_follow_their_original_and_placed_vehicles_their_path(recorder):
    """The oncoming vehicle drives against x: 12 m behind it are 12 m further along x, its left is towards -y. Points of
    a path are relative to the ego vehicle at the first image; here it drives along x at y = -1.75."""
    before, after = poses(recorder, "vehicle 1"), poses(recorder, "twin", "copied")
    np.testing.assert_allclose(after[:, 0, 3] - before[:, 0, 3], 12.0, atol=0.05)
    np.testing.assert_allclose(after[:, 1, 3] - before[:, 1, 3], -0.5, atol=0.15)
    times = TIMES[TIMES > 2.0]
    expected = named(recorder, "vehicle 1").poses(times - 2.0)
    np.testing.assert_allclose(named(recorder, "twin", "late").poses(times), expected, atol=2e-3)
    found, start = poses(recorder, "new", "placed"), recorder.ego_pose(FILM_START)
    film = TIMES - FILM_START
    on_path = np.stack([60.0 - 5.0 * film, np.full(len(film), 3.5), np.zeros(len(film))], axis=-1)
    expected = on_path @ start[:3, :3].T + start[:3, 3]
    np.testing.assert_allclose(found[:, :2, 3], expected[:, :2], atol=0.02)
    assert (found[:, :3, 0] @ start[:3, :3] @ [-1.0, 0.0, 0.0]).min() > 0.9995, "it faces along its path"
    assert np.abs(found[:, 2, 3]).max() < 0.1, "on the road, as high as the ego vehicle sways"


def test_a_recoloured_vehicle_is_where_it_was_in_other_colours(recorder):
    """Pixels of dull surfaces change by the matrix of the step; paint and glass mirror the sky as before."""
    seen, matrix = 4_000_000, color_matrix(Recolour(track=AHEAD, hue=120.0, value=0.9))
    before, after = (recorder.picture(FRONT, seen, Viewpoint(edit=edit)) for edit in (None, "painted"))
    np.testing.assert_array_equal(before.depth, after.depth)
    car = (before.objects == names_of(recorder).index("vehicle 0")) & np.isfinite(before.depth)
    then, now = (to_bytes(picture.radiance) / 255.0 for picture in (before, after))
    np.testing.assert_array_equal(then[~car], now[~car])
    pixels = then[car], now[car]
    error = np.abs(pixels[0] @ matrix.T - pixels[1]).max(axis=1)
    assert len(error) > 30 and (error < 0.02).mean() > 0.3 and np.median(error) < 0.1
    assert np.median(np.abs(pixels[0] - pixels[1]).max(axis=1)) > 0.02


def test_ego_steps_move_the_camera_the_lidar_and_the_ego_vehicles_body(recorder):
    view = Viewpoint(edit="ego aside")
    before, after = recorder.ego_to_street(TIMES), recorder.ego_to_street(TIMES, view)
    np.testing.assert_allclose(after[:, :3, 3] - before[:, :3, 3], before[:, :3, 1], atol=1e-6)
    np.testing.assert_allclose(after[:, :3, :3], before[:, :3, :3], atol=1e-6)
    body = named(recorder, EGO_BODY, "ego aside")
    np.testing.assert_allclose(body.poses(TIMES), after, atol=1e-9)
    np.testing.assert_allclose(named(recorder, EGO_BODY).poses(TIMES), before, atol=1e-9)
    scans = [recorder.scan(LIDAR, 2_000_000, v) for v in (Viewpoint(), view)]
    own = [found.object == names_of(recorder, v).index(EGO_BODY) for found, v in zip(scans, (None, "ego aside"))]  # noqa: B905
    np.testing.assert_allclose(scans[0].range[own[0] & own[1]], scans[1].range[own[0] & own[1]], atol=1e-4)
    assert own[0].sum() > 100


def test_a_slower_ego_vehicle_and_one_that_changes_the_lane_follow_the_recorded_path(recorder):
    before, after = recorder.ego_to_street(TIMES), recorder.ego_to_street(TIMES, Viewpoint(edit="ego later"))
    offset = np.einsum("ni,ni->n", after[:, :3, 3] - before[:, :3, 3], before[:, :3, 1])
    film = TIMES - FILM_START
    slower = recorder.ego_to_street(TIMES, Viewpoint(edit="ego slower"))
    np.testing.assert_allclose(slower, recorder.ego_to_street(0.5 * film + FILM_START), atol=1e-9)
    assert np.abs(offset[film < 4.0]).max() < 1e-9
    np.testing.assert_allclose(offset[film > 6.01], 2.0, atol=1e-6)
    halfway = recorder.ego_to_street(np.array([5.0 + FILM_START]), Viewpoint(edit="ego later"))[0]
    there = recorder.ego_pose(5.0 + FILM_START)
    turned = np.degrees(np.arctan2(halfway[:3, 0] @ there[:3, 1], halfway[:3, 0] @ there[:3, 0]))
    speed = np.linalg.norm((recorder.ego_pose(5.01) - recorder.ego_pose(4.99))[:3, 3]) / 0.02
    assert turned == pytest.approx(np.degrees(np.arctan2(1.875, speed)), abs=0.3), "a quintic's slope is 15/8"


def refusal(*steps: dict, check=None, **world) -> str:
    """Why an edit of these steps is refused, when it is resolved or by `check`."""
    recorder = recorder_of({"odd": edit_of(*steps)}, **world)
    with pytest.raises(ConfigError) as refused:
        recorder.variation("odd")
        check(recorder)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def placed(*path: list) -> dict:
    return {"place": {"track": ONCOMING, "as": "new", "path": list(path)}}


def test_people_riders_and_unknown_tracks_are_refused_with_the_tracks_there_are():
    nobody = "scene demo, edit 'odd', step 1 (remove): no editable track has an id starting with "
    person, rider = (instance_token("demo", name) for name in ("pedestrian 0", "cyclist 0"))
    for track in ("ffff0000", person, rider):
        said = refusal({"remove": {"track": track}}, cyclists=1)
        assert said.startswith(f"{nobody}'{track}'") and AHEAD[:8] in said
    assert "is the id of another track" in refusal({"duplicate": {"track": ONCOMING, "as": person}}, cyclists=1)


@pytest.mark.slow
def test_a_vehicle_placed_inside_a_parked_one_is_refused():
    parked = pose_at(named(recorder_of(key_frames=12), "parked 0"), 0.0)[:3, 3]
    ahead = np.linalg.inv(recorder_of(key_frames=12).ego_pose(FILM_START)) @ [*parked, 1.0]
    said = refusal(placed([0.0, ahead[0] + 0.5, ahead[1]]), check=require_free_places, key_frames=12)
    assert said == "scene demo, edit 'odd', step 1 (place): 'new' is inside parked 0 at 0.0 s; choose another path"


@pytest.mark.slow
def test_a_vehicle_that_drives_into_a_wall_is_refused_with_the_second_and_one_on_the_free_road_is_accepted():
    steps = {"shift": {"track": AHEAD, "lateral": 0.2}}, placed([0.0, 20.0, 3.5], [4.0, 40.0, 16.0])
    said = refusal(*steps, check=require_free_places, key_frames=12, parked=0, pedestrians=0)
    assert said.startswith("scene demo, edit 'odd', step 2 (place): 'new' is inside scenery at ")
    assert "; choose another" in said and 1.0 < float(said.split(" at ")[1].split(" s;")[0]) < 4.0
    clear = edit_of(placed([0.0, 60.0, 3.5]), {"remove": {"track": ONCOMING}})
    gone = edit_of(placed([0.0, 30.0, 14.0]), {"remove": {"track": "new"}})
    require_free_places(recorder_of({"clear": clear, "gone": gone}, key_frames=12))


def test_objects_of_another_world_stand_where_they_are_inserted_and_are_told_apart():
    donor = WorldDonor(scene="other", track=instance_token("other", "vehicle 1")[:8], world=world_of(random_seed=5))
    edit = edit_of({"insert": {"asset": "other/car", "as": "new", "at": [30.0, 3.5], "yaw": 90.0}})
    recorder = Recorder(world_of(), "demo", {"inserted": edit}, {"other/car": donor})
    original = next(item for item in Recorder(donor.world, "other").objects if item.name == "vehicle 1")
    new = named(recorder, "new", "inserted")
    np.testing.assert_array_equal(new.size, original.size)
    assert new.category == original.category and "new" not in names_of(recorder, None)
    ahead = np.linalg.inv(recorder.ego_pose(0.0)) @ pose_at(new, 3.0)
    np.testing.assert_allclose(ahead[:3, 3], [30.0, 3.5, 0.0], atol=0.3)
    with pytest.raises(ConfigError, match=r"asset 'other/car': no object has an id starting with 'zz' in scene other"):
        Recorder(world_of(), "demo", {}, {"other/car": donor.model_copy(update={"track": "zz"})})


def test_an_inserted_object_inside_another_is_refused():
    donor = WorldDonor(scene="other", track=instance_token("other", "vehicle 1"), world=world_of(random_seed=5))
    edit = edit_of({"insert": {"asset": "other/car", "as": "new", "follow": AHEAD}})
    with pytest.raises(ConfigError, match=r"step 1 \(insert\): 'new' is inside vehicle 0 at 0\.0 s"):
        require_free_places(Recorder(world_of(), "demo", {"inside": edit}, {"other/car": donor}))
