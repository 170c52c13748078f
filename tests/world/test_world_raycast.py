"""Ray casting on many scenes: their number, their memory, and processes that are forked."""

import multiprocessing

import numpy as np
import pytest
from helpers.demo_worlds import FRONT, names_of, world_of
from helpers.patience import PATIENCE_S

from drivesplat.world.optics.raycast import RayCaster, StreetRays
from drivesplat.world.recorder import Recorder
from drivesplat.world.shapes.body import RigidBody
from drivesplat.world.shapes.mesh import Material, box
from drivesplat.world.street.objects import StreetObject
from drivesplat.world.street.paths import GivenPath

MANY = 1200
"""Embree allows a process about a thousand devices."""


def moving_box(number: int) -> StreetObject:
    """A box of a metre, `number` metres ahead, that moves to the left at 1 m/s."""

    def poses(seconds: np.ndarray) -> np.ndarray:
        found = np.tile(np.eye(4), (len(seconds), 1, 1))
        found[:, 0, 3], found[:, 1, 3] = 3.0 * number, seconds
        return found

    mesh = box((-0.5, -0.5, 0.0), (0.5, 0.5, 1.0), Material.PLAIN, (0.5,) * 3)
    return StreetObject(f"box {number}", RigidBody(mesh), GivenPath(poses))


def test_more_than_a_thousand_moving_pieces_are_hit_at_their_own_times():
    caster = RayCaster([moving_box(number) for number in range(MANY)])
    seconds = np.array([0.0, 2.0])
    rows = np.arange(MANY)
    origins = np.stack([[0.0, 0.0, 5.0], [0.0, 0.0, 5.0]])
    for moment, left in ((0, 0.0), (1, 2.0)):
        toward = np.stack([3.0 * rows, np.full(MANY, left), np.full(MANY, -4.5)], axis=-1)
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        hits = caster.at(seconds).cast(StreetRays(seconds, origins, toward, np.full(MANY, moment, np.int32)))
        assert (hits.object[:200] >= 0).all() and (hits.object[:5] == rows[:5]).all()
    assert hits.object.max() > 50


def shown(recorder: Recorder) -> bytes:
    return recorder.geometry(FRONT, 0).objects.tobytes()


def _in_child(results) -> None:
    results.put(shown(Recorder(world_of(cyclists=1))))


@pytest.mark.slow
def test_a_forked_process_casts_rays_of_its_own():
    """The parent has cast rays before it forks, as for the check of placed vehicles."""
    recorder = Recorder(world_of(cyclists=1))
    assert "cyclist 0" in names_of(recorder)
    here = shown(recorder)
    context = multiprocessing.get_context("fork")
    results = context.Queue()
    child = context.Process(target=_in_child, args=(results,))
    child.start()
    assert results.get(timeout=PATIENCE_S) == here
    child.join(timeout=PATIENCE_S)
    assert child.exitcode == 0
