"""Policies by themselves, and the runs file."""

import math
import sys

import numpy as np
import pytest
from helpers.hand_made import about_z

from drivesplat.errors import ConfigError, RequestError
from drivesplat.simulate.corridor import first_in_the_way
from drivesplat.simulate.policies import ConstantSpeed, PurePursuit, RecordedEgo, bend_speed, policy_of, pursuit
from drivesplat.simulate.simulation import BOX_COLUMNS
from drivesplat.workflow.runs_file import code_of, read_runs

STRAIGHT = np.column_stack([np.arange(2.0, 42.0, 2.0), np.zeros(20), np.zeros(20)]).astype(np.float32)


def seen(speed: float = 10.0, route=STRAIGHT, boxes=()) -> dict:
    padded = np.zeros((8, len(BOX_COLUMNS)), dtype=np.float32)
    for row, box in zip(padded, boxes, strict=False):
        row[:] = box
    return {"ego": np.array([speed, 0, 0, 0, 0], dtype=np.float32), "route": route, "boxes": padded}


def box(x: float, y: float = 0.0, speed: float = 0.0, yaw: float = 0.0, z: float = 0.8) -> tuple[float, ...]:
    return x, y, z, 4.0, 2.0, 1.6, yaw, speed


MINE = """
class Mine:
    def __init__(self, a):
        self.a = a

    def act(self, seen, facts):
        return [self.a, 0]
"""


# ---- what drives


def test_pursuit_steers_along_the_arc_through_the_point_ahead():
    radius, wheelbase = 30.0, 2.8
    angles = np.arange(1, 21) * 2.0 / radius
    circle = np.column_stack([radius * np.sin(angles), radius * (1 - np.cos(angles)), angles]).astype(np.float32)
    for speed in (2.0, 10.0):
        assert pursuit(circle, speed, wheelbase) == pytest.approx(math.atan(wheelbase / radius), rel=1e-3)
    mirrored = circle * np.array([1, -1, -1], dtype=np.float32)
    assert pursuit(mirrored, 5.0, wheelbase) == pytest.approx(-math.atan(wheelbase / radius), rel=1e-3)
    assert pursuit(STRAIGHT, 10.0, wheelbase) == 0.0


def test_pursuit_of_a_short_route_aims_at_its_end():
    short = np.array([[2.0, 0.0, 0.0], [4.0, 0.2, 0.1], [6.0, 1.0, 0.2]], dtype=np.float32)
    assert pursuit(short, 20.0, 2.8) == pytest.approx(math.atan2(2.0 * 2.8 * 1.0, 37.0))


def test_policies_know_the_vehicle_that_they_drive():
    long = {"vehicle": {"length": 10.6, "rear_overhang": 0.9, "wheelbase": 6.0}}
    boxes = [box(40.0)]
    _, push = PurePursuit().act(seen(boxes=boxes), {})
    _, sooner = PurePursuit().act(seen(boxes=boxes), long)
    assert sooner < push - 0.5
    turned = STRAIGHT + np.array([0, 1, 0], dtype=np.float32)
    assert ConstantSpeed().act(seen(route=turned), long)[0] > 1.5 * ConstantSpeed().act(seen(route=turned), {})[0]


def test_bends_are_taken_with_their_lateral_acceleration():
    angles = np.arange(1, 21) * 2.0 / 20.0
    circle = np.column_stack([20.0 * np.sin(angles), 20.0 * (1 - np.cos(angles)), angles]).astype(np.float32)
    assert bend_speed(circle) == pytest.approx(math.sqrt(2.5 * 20.0 + 2.0 * 2.0 * 2.0), rel=0.1)
    assert bend_speed(STRAIGHT) > 50.0


@pytest.mark.parametrize(
    ("boxes", "brakes"),
    [
        ([], False),
        ([box(14.0)], True),
        ([box(14.0, 3.5)], False),  # in the next lane
        ([box(-14.0)], False),  # behind
        ([box(14.0, z=4.5)], False),  # a bridge
        ([box(14.0, 2.2, yaw=math.pi / 2)], True),  # across the lane
        ([box(35.0, speed=10.0)], False),  # drives ahead as fast
        ([box(35.0, speed=10.0, yaw=math.pi)], True),  # comes towards it
    ],
)
def test_pure_pursuit_brakes_for_what_is_in_its_way(boxes, brakes):
    _, push = PurePursuit(speed=10.0).act(seen(boxes=boxes), {})
    assert (push < -1.0) == brakes and push >= -8.0


def test_pure_pursuit_drives_beside_the_path_where_it_shall():
    left, _ = PurePursuit(lateral=3.5).act(seen(), {})
    right, _ = PurePursuit(lateral=-3.5).act(seen(), {})
    assert left > 0.05 and right == pytest.approx(-left)


def test_constant_speed_keeps_the_first_speed_of_each_run():
    policy = ConstantSpeed()
    policy.reset(0)
    assert policy.act(seen(8.0), {})[1] == 0.0 and policy.act(seen(7.0), {})[1] == pytest.approx(2.0)
    policy.reset(1)
    assert policy.act(seen(7.0), {})[1] == 0.0
    assert ConstantSpeed(12.0).act(seen(10.0), {})[1] == pytest.approx(4.0)


def test_the_nearest_edge_on_a_bent_path_is_found():
    angles = np.linspace(0.0, math.pi / 2, 100)
    path = 20.0 * np.column_stack([np.sin(angles), 1 - np.cos(angles)])
    turned = about_z(math.pi / 4)[:2, 0]
    centres = np.array([20.0 * np.array([math.sin(math.pi / 4), 1 - math.cos(math.pi / 4)]), [20.0, 0.0]])
    found = first_in_the_way(path, centres, np.array([turned, [1.0, 0.0]]), np.array([[4.0, 2.0]] * 2), 2.0)
    assert found.index == 0 and found.near == pytest.approx(20.0 * math.pi / 4 - 2.0, abs=0.1)
    assert found.cosine == pytest.approx(1.0, abs=1e-3)
    nothing = np.zeros((0, 2))
    assert first_in_the_way(path, nothing, nothing, nothing, 2.0) is None
    assert first_in_the_way(path[:1], centres, np.array([turned, turned]), np.ones((2, 2)), 2.0) is None


# ---- policies by name


def test_policies_are_made_by_name_or_entry_point(tmp_path, monkeypatch):
    assert isinstance(policy_of("recorded", {}), RecordedEgo) and RecordedEgo.follows_recording
    (tmp_path / "my_policies.py").write_text(MINE)
    monkeypatch.syspath_prepend(str(tmp_path))
    assert policy_of("my_policies:Mine", {"a": 0.1}).act({}, {}) == [0.1, 0]
    digest = code_of("my_policies:Mine")
    (tmp_path / "my_policies.py").write_text("Mine = 3\n")
    assert code_of("my_policies:Mine") != digest and code_of("pure_pursuit") is None
    assert code_of("nowhere_at_all:Mine") is None
    sys.modules.pop("my_policies", None)


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("fast", {}, "there is no policy 'fast'; there are: recorded, constant_speed, pure_pursuit"),
        ("nowhere_at_all:Mine", {}, "cannot be made: ModuleNotFoundError"),
        ("math:nothing", {}, "cannot be made: AttributeError"),
        ("pure_pursuit", {"sped": 3}, "cannot be made"),
        ("types:SimpleNamespace", {}, "has no method `act`"),
    ],
)
def test_what_is_no_policy_is_refused_in_one_sentence(name, settings, message):
    with pytest.raises(RequestError, match=message) as error:
        policy_of(name, settings)
    assert "\n" not in str(error.value)


# ---- the runs file


def written(tmp_path, text: str):
    (tmp_path / "runs.yaml").write_text(text)
    return tmp_path / "runs.yaml"


def test_runs_are_read_in_order_with_their_defaults(tmp_path):
    runs = read_runs(written(tmp_path, "runs:\n  b: {policy: recorded}\n  a: {policy: 'm:P', seeds: [1, 2], "
                                       "simulation: {rate_hz: 20, traffic: {people: stop}}}\n"))  # fmt: skip
    assert list(runs) == ["b", "a"] and runs["b"].seeds == (0,) and runs["b"].methods == ("street",)
    assert runs["a"].simulation.rate_hz == 20.0 and runs["a"].simulation.traffic.people == "stop"
    assert read_runs(written(tmp_path, "runs:\n")) == {}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "holds the one key 'runs'"),
        ("runs: [1]", "it holds settings per name"),
        ("runs: {'a/b': {policy: recorded}}", "cannot name a file"),
        ("runs: {a: fast}", "run 'a' is .*; it is a mapping"),
        ("runs: {a: {}}", "run 'a': .*policy"),
        ("runs: {a: {policy: recorded, sed: 3}}", "sed"),
        ("runs: {a: {policy: recorded, simulation: {rate_hz: -1}}}", "rate_hz"),
        ("runs: {a: {policy: recorded, simulation: {cameras: [A, A]}}}", "a name stands twice"),
        ("runs: {a: {policy: recorded, seeds: []}}", "seeds"),
    ],
)
def test_a_runs_file_that_is_wrong_is_refused_in_one_line(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message) as error:
        read_runs(written(tmp_path, text))
    assert "\n" not in str(error.value) and "runs.yaml" in str(error.value)
