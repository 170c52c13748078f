"""Edits of long drives: each block shows its objects where the edited drive has them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.hand_made import actors_of, round_gaussians
from helpers.hand_made_street import (
    AHEAD,
    DRIVERS,
    GONE,
    SETTINGS,
    TURNING,
    Reels,
    a_format,
    checkpoint_of,
    street_model,
)

from drivesplat.editing.block_edit import EditedDrive, render_block_edit
from drivesplat.editing.film import EditFiles, render_edit
from drivesplat.errors import ConfigError
from drivesplat.model.checkpoint import write_checkpoint
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.timeline import ActorTrack
from drivesplat.preprocess.blocks import block_scene
from drivesplat.rendering.captions import DARK
from drivesplat.scene.blocks import Block, Blocks
from drivesplat.scene.scene import Scene, write_scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.edit import Edit
from drivesplat.settings.images import HoldoutSettings
from drivesplat.settings.render import BlockEditJob, EditJob
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.trajectories.motion import Motion

CPU = DeviceSettings(kind="cpu")
HOLDOUT = HoldoutSettings()
ORIGINS = np.array([[0.0, 0.0], [10.0, -4.0]])
EVERYTHING = [
    {"shift": {"track": AHEAD, "lateral": 2.0, "start": 1.0}},
    {"stop": {"track": AHEAD, "at": 3.0}},
    {"duplicate": {"track": AHEAD, "as": "twin", "longitudinal": -6.0}},
    {"remove": {"track": TURNING}},
    {"recolour": {"track": GONE, "hue": 120.0}},
    {"ego": {"lateral": 0.5}},
]


def in_block(number: int, begins: float) -> SplatModel:
    """The street as the block has learned it, whose world begins elsewhere and later, without corrections of tracks."""
    shift, places = np.append(ORIGINS[number], 0.0), street_model().parts[0].params["means"]
    tracks = []
    for name, driver in DRIVERS.items():
        poses = driver.motion.object_to_world.copy()
        poses[:, :3, 3] -= shift
        times = driver.motion.times - begins
        tracks.append(ActorTrack(name, np.array(driver.size), Motion(times, poses, driver.runs, 0.25)))
    rng = np.random.default_rng(0)
    rng.uniform(size=(150, 3))
    colors = rng.uniform(0.0, 1.0, (150, 3)).tolist()
    actors = actors_of(*tracks, count=30, settings=SETTINGS.actors)
    with torch.no_grad():
        for correction in actors.shared.values():
            correction[:] = 0.0
    return street_model(round_gaussians(places.numpy() - shift, 0.4, colors=colors), actors)


class LongStreet:
    """The street in two blocks, as files."""

    def __init__(self, scene: Scene, folder: Path):
        stamps = sorted(frame.timestamp for frame in scene.frames)
        middle, second = stamps[len(stamps) // 2], 1_000_000
        cores = [np.array([[stamps[0], middle]]), np.array([[middle, stamps[-1] + second]])]
        used = [np.array([[stamps[0], middle + second]]), np.array([[middle - second, stamps[-1] + second]])]
        made = (Block(*own, ORIGINS[i : i + 1]) for i, own in enumerate(zip(cores, used, strict=True)))
        self.scene, self.blocks = scene, Blocks(scene.name, tuple(made))
        self.own = [block_scene(scene, self.blocks, number, HOLDOUT) for number in range(2)]
        self.begins = [scene.seconds(min(frame.timestamp for frame in own.frames)) for own in self.own]
        self.scenes = [str(folder / f"{number}.json") for number in range(2)]
        self.checkpoints = [str(folder / f"{number}.npz") for number in range(2)]
        for number, own in enumerate(self.own):
            write_scene(self.scenes[number], own)
            write_checkpoint(self.checkpoints[number], checkpoint_of(in_block(number, self.begins[number])))

    def edited(self, folder: Path, *steps: dict[str, Any], left_out: tuple[int, ...] = ()) -> tuple[dict, np.ndarray]:
        """The record and the film of an edit, (n, h, w, 3)."""
        job = BlockEditJob(edit=an_edit(*steps), left_out=left_out, **a_format(captions=False).model_dump())
        files, kept = EditFiles(folder / "it.mp4", folder / "it.png"), self.blocks.without(left_out)
        with pytest.MonkeyPatch.context() as patch:
            reels = Reels()
            patch.setattr("drivesplat.rendering.film.write_video", reels)
            of_blocks = ([paths[i] for i in kept] for paths in (self.scenes, self.checkpoints))
            record, _ = render_block_edit(self.scene, self.blocks, *of_blocks, job, CPU, files)
        return record, reels["it"]


def an_edit(*steps: dict[str, Any]) -> Edit:
    return Edit.model_validate({"steps": steps})


@pytest.fixture(scope="module")
def street(scene, tmp_path_factory) -> LongStreet:
    return LongStreet(scene, tmp_path_factory.mktemp("street"))


def undivided(scene: Scene, folder: Path, *steps: dict[str, Any]) -> np.ndarray:
    """The film of the same edit of the same street in one piece."""
    job = EditJob(edit=an_edit(*steps), **a_format(captions=False).model_dump())
    with pytest.MonkeyPatch.context() as patch:
        reels = Reels()
        patch.setattr("drivesplat.rendering.film.write_video", reels)
        render_edit(scene, checkpoint_of(in_block(0, 0.0)), job, CPU, EditFiles(folder / "it.mp4", folder / "it.png"))
    return reels["it"]


def test_an_edit_in_blocks_looks_like_that_of_the_undivided_drive(scene, street, tmp_path):
    record, film = street.edited(tmp_path, *EVERYTHING)
    assert street.begins[1] > 1.0, "the second block has a clock of its own"
    expected = undivided(scene, tmp_path, *EVERYTHING)
    assert film.shape == expected.shape
    assert np.abs(film.astype(int) - expected).max() <= 2
    before, after = np.split(film, 2, axis=2)
    assert (before != after).any(axis=(1, 2, 3)).all()
    assert record["blocks"] == {f"{scene.name}.00{i}": sorted([AHEAD, GONE, "twin"]) for i in range(2)}
    assert record["frames"] == len(film) and record["left_out"] == [] and (tmp_path / "it.png").is_file()


def test_a_slower_vehicle_is_longer_in_the_blocks_where_it_is(scene, street, tmp_path):
    slow = {"ego": {"speed": 0.2}}
    record, film = street.edited(tmp_path, slow)
    assert [*record["blocks"]] == [f"{scene.name}.000"], "it does not reach the second block"
    assert np.abs(film.astype(int) - undivided(scene, tmp_path, slow))[:, :, 64:].mean() < 1.0


def test_frames_of_a_block_that_is_left_out_are_dark_in_both_panels(scene, street, tmp_path):
    record, film = street.edited(tmp_path, *EVERYTHING, left_out=(0,))
    own = np.array([street.blocks.at(stamp) for stamp in record["timestamps"]])
    dark = (np.median(film, axis=(1, 2, 3)) == DARK) & (film[:, 0, 0, 0] == DARK)
    np.testing.assert_array_equal(dark, own == 0)
    assert record["left_out"] == [f"{scene.name}.000"] and [*record["blocks"]] == [f"{scene.name}.001"]


def drive_and_block(street: LongStreet, *steps: dict[str, Any], learned: tuple[str, ...] = tuple(DRIVERS)):
    """The actors of the edited drive and those of its second block, by id, and of the block as learned."""
    job = BlockEditJob(edit=an_edit(*steps), **a_format().model_dump())
    drive, block = EditedDrive.of(street.scene, job, "edit"), street.own[1]
    own = [
        EditedActor.recorded(t.id, t.object_class, t.category, t.size, Motion.of_track(block, t))
        for t in block.tracks
        if t.id in learned
    ]
    found = drive.in_block(own, block)
    return {a.id: a for a in drive.actors}, {a.id: a for a in found}, {a.id: a for a in own}


def test_changed_paths_are_those_of_the_drive_in_the_time_and_world_of_the_block(street):
    of_drive, of_block, own = drive_and_block(street, {"stop": {"track": AHEAD, "at": 1.0}})
    times = np.linspace(0.0, 2.0, 9)
    poses = of_drive[AHEAD].poses(times + street.begins[1])
    poses[:, :3, 3] -= np.append(ORIGINS[1], 0.0)
    np.testing.assert_allclose(of_block[AHEAD].poses(times), poses, atol=1e-9)
    np.testing.assert_array_equal(of_block[AHEAD].present(times), of_drive[AHEAD].present(times + street.begins[1]))
    assert of_block[TURNING] is own[TURNING], "as the block has learned it"


def test_limbs_go_on_as_the_block_has_learned_them(street):
    _, of_block, own = drive_and_block(street, {"shift": {"track": AHEAD, "lateral": 1.0}})
    times = np.linspace(0.2, 1.5, 5)
    np.testing.assert_allclose(of_block[AHEAD].walked(times), own[AHEAD].walked(times), atol=0.05)


def test_objects_that_a_block_has_not_learned_are_absent_in_it(street):
    steps = {"duplicate": {"track": AHEAD, "as": "twin", "delay": 1.0}}, {"recolour": {"track": GONE, "hue": 90.0}}
    _, of_block, own = drive_and_block(street, *steps, learned=(GONE,))
    assert [*of_block] == [GONE]
    assert of_block[GONE].path is own[GONE].path and of_block[GONE].color_matrix is not None


def test_objects_that_no_block_has_learned_are_named(scene, street, tmp_path, caplog):
    parked = next(track.id for track in scene.tracks if track.id not in DRIVERS)
    street.edited(tmp_path, {"remove": {"track": parked}}, {"remove": {"track": TURNING}})
    said = [record.message for record in caplog.records if "has learned" in record.message]
    assert said == [
        f"scene {scene.name}, edit 'it': no block has learned {parked} as an object of its own, so that the edit does "
        "not change it"
    ]


def test_an_edit_that_does_not_fit_the_drive_is_refused(street, tmp_path):
    with pytest.raises(ConfigError, match=rf"scene {street.scene.name}, edit 'it', step 1 .*: no editable track"):
        street.edited(tmp_path, {"remove": {"track": "nobody"}})
    replaced = replace(street.scene, tracks=())
    with pytest.raises(ConfigError, match="no editable track"):
        EditedDrive.of(replaced, BlockEditJob(edit=an_edit(EVERYTHING[3]), **a_format().model_dump()), "edit")
