"""What some methods train on and others do not: the stages `actors` and `lidar_depth` run for those that take them."""

import pytest
from helpers.workflow_copy import WorkflowCopy

from drivesplat.lidar.depth_record import read_lidar_depth
from drivesplat.trajectories.actor_record import read_actors

pytestmark = [pytest.mark.workflow, pytest.mark.slow, pytest.mark.xdist_group("inputs")]

ACTORS = ["background", "actors"]
HELD = {"train": {"depth_weight": 0.01, "road_weight": 0.1}}
TRAININGS = [f"results/0001/{method}/train.json" for method in ("vanilla", "mine")]


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> WorkflowCopy:
    """A method without actors and one with them, trained on one scene."""
    methods = {"vanilla": {}, "mine": {"parts": ACTORS, "overrides": HELD}}
    copy = WorkflowCopy.make(tmp_path_factory.mktemp("inputs"), methods=methods, actors={"random_points": 200})
    done = copy.run(*TRAININGS)
    assert done.returncode == 0, done.stdout
    return copy


def test_the_stages_leave_records_that_know_where_they_come_from(trained):
    folder = trained.folder / "results/0001"
    actors, depth = read_actors(folder / "actors.npz"), read_lidar_depth(folder / "lidar_depth.npz")
    assert [actor.category for actor in actors.actors] == ["vehicle.car"]
    assert sum(len(image) > 0 for image in depth.images) == 5
    assert actors.provenance["stages"].keys() == {"extract", "own_car", "actors"}
    assert depth.provenance["stages"].keys() == {"extract", "own_car", "lidar_depth"}
    made_from = [trained.read(training)["provenance"]["stages"].keys() for training in TRAININGS]
    assert made_from[1] - made_from[0] == {"actors", "lidar_depth", "mine/train"}


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ({}, {}),
        ({"actors": {"random_points": 300}}, {"actors": 1, "train": 1}),
        ({"lidar_seed": {"own_car_radius": 3.0}},
         {"lidar_seed": 1, "parser": 1, "actors": 1, "lidar_depth": 1, "train": 2}),
        ({"random_seed": 1}, {"lidar_seed": 1, "parser": 1, "actors": 1, "train": 2}),
        ({"methods": {"mine": {"parts": ACTORS}}}, {"train": 1}),
    ],
)  # fmt: skip
def test_a_changed_setting_reruns_its_stage_and_the_trainings_that_take_it(trained, setting, expected):
    before = trained.config
    changed = {
        key: {**before.get(key, {}), **value} if isinstance(value, dict) else value for key, value in setting.items()
    }
    trained.config = {**before, **changed}
    trained.write_config()
    try:
        assert trained.planned(*TRAININGS) == expected
    finally:
        trained.config = before
        trained.write_config()


@pytest.mark.parametrize(
    ("file", "old", "new", "expected"),
    [
        ("drivesplat/preprocess/actor_seed.py", "UNSEEN = 127", "UNSEEN = 128", {"actors": 1, "train": 1}),
        ("drivesplat/lidar/depth.py", "static &= ~item", "static &= item", {"lidar_depth": 1, "train": 1}),
    ],
)
def test_code_that_makes_them_reruns_no_training_that_does_not_take_them(trained, file, old, new, expected):
    path = trained.folder / file
    before = path.read_text()
    assert old in before
    path.write_text(before.replace(old, new, 1))
    try:
        assert trained.planned(*TRAININGS) == expected
    finally:
        path.write_text(before)
