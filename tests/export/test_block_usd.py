"""scene.usd of a long drive as OpenUSD reads it again: payloads where their blocks lie, and nothing stands twice."""

from dataclasses import replace

import numpy as np
import pytest
from helpers.hand_made import round_gaussians
from helpers.hand_made_traffic import REACH, TRAJECTORIES, Traffic, own_gaussians
from helpers.records import EMPTY_CHECKPOINT
from pxr import Gf, Usd, UsdGeom, UsdUtils, UsdValidation, UsdVol

from drivesplat.errors import ConfigError
from drivesplat.export import block_usd
from drivesplat.export.block_usd import BLOCKS, BlockFiles, export_payloads, write_drive
from drivesplat.export.far_gaussians import FarGaussians
from drivesplat.export.usd import recorded_cameras
from drivesplat.model.part import RigidGroup
from drivesplat.model.splat_model import SplatModel
from drivesplat.preprocess.blocks import block_scene
from drivesplat.scene.blocks import Block, Blocks
from drivesplat.scene.scene import Scene, write_scene
from drivesplat.settings.export import BlockUsdJob
from drivesplat.settings.images import HoldoutSettings
from drivesplat.trajectories.motion import Motion

PROVENANCE = {"settings_sha256": "a" * 64, "code_sha256": "b" * 64, "inputs_sha256": "c" * 64, "stages": {}}
STREET = np.array([[x, y, 0.5] for x in np.arange(-3.0, 25.0, 1.3) for y in (-3.0, 3.0)])
"""Static places of the whole drive, in its world (n, 3). Every block has learned all of them."""
JOB = BlockUsdJob(eval_camera="CAM_FRONT", gaussians=1000, left_out=())


class MovedTraffic(Traffic):
    """The vehicles of a drive in a block that begins `seconds` later, with the origin of its world at `origin` (3,)."""

    def __init__(self, seconds: float, origin: np.ndarray):
        super().__init__()
        self._seconds, self._origin = seconds, origin

    def rigid_groups(self, time: float) -> dict[str, RigidGroup]:
        return {name: RigidGroup(own_gaussians(name, time), self._motion(name)) for name in TRAJECTORIES}

    def _motion(self, name: str) -> Motion:
        trajectory = TRAJECTORIES[name]
        poses = np.stack([trajectory.pose(time) for time in trajectory.times])
        poses[:, :3, 3] -= self._origin
        return Motion(np.array(trajectory.times) - self._seconds, poses, trajectory.runs, REACH)


@pytest.fixture(scope="module")
def blocks(tiny_scene) -> Blocks:
    """Three blocks of 1.5 s each, about six metres, which overlap by a second."""
    first, last = (pick(frame.timestamp for frame in tiny_scene.frames) for pick in (min, max))
    ends = [first, first + 1_600_000, first + 3_100_000, last + 100_000]
    found = []
    for number in range(3):
        core = np.array([[ends[number], ends[number + 1]]])
        used = np.array([[max(first, core[0, 0] - 1_000_000), min(last + 100_000, core[0, 1] + 1_000_000)]])
        places = [f.ego_to_world[:2, 3] for f in tiny_scene.frames if core[0, 0] <= f.timestamp < core[0, 1]]
        found.append(Block(core, used, np.stack(places)))
    return Blocks(tiny_scene.name, tuple(found))


def exported(folder, scene: Scene, blocks: Blocks, monkeypatch, job: BlockUsdJob = JOB):
    """scene.usd with its payloads, of models that know the whole street and its traffic."""
    scenes = [block_scene(scene, blocks, number, HoldoutSettings()) for number in range(len(blocks.blocks))]
    for own in scenes:
        write_scene(folder / f"{own.name}.json", own)
    models = {}
    for own, block in zip(scenes, blocks.blocks, strict=True):
        seconds = scene.seconds(min(frame.timestamp for frame in own.frames))
        static = round_gaussians(STREET - block.origin, sizes=0.05)
        models[own.name] = SplatModel([static, MovedTraffic(seconds, block.origin)], None)
    nothing = np.zeros(0, dtype=np.int64)
    far = FarGaussians(nothing, nothing, np.zeros((0, 3), np.float32), np.zeros(0, np.float32), 0.0, 0, PROVENANCE)
    monkeypatch.setattr(block_usd, "read_far", lambda _: far)
    of_block = {name: replace(EMPTY_CHECKPOINT, provenance={**PROVENANCE, "of": name}) for name in models}
    monkeypatch.setattr(block_usd, "read_checkpoint", of_block.__getitem__)
    monkeypatch.setattr(block_usd, "trained_model", lambda checkpoint: models[checkpoint.provenance["of"]])
    numbers = blocks.without(job.left_out)
    files = [BlockFiles(str(folder / f"{blocks.names[i]}.json"), blocks.names[i], "") for i in numbers]
    payloads, upstream = export_payloads(folder / "usd", scene, blocks, files, job)
    assert [own["of"] for own in upstream] == [blocks.names[i] for i in numbers]
    write_drive(folder / "scene.usd", scene, payloads, job, PROVENANCE)
    return folder / "scene.usd"


@pytest.fixture(scope="module")
def file(tmp_path_factory, tiny_scene, blocks):
    with pytest.MonkeyPatch.context() as monkeypatch:
        yield exported(tmp_path_factory.mktemp("usd"), tiny_scene, blocks, monkeypatch)


@pytest.fixture(scope="module")
def stage(file):
    return Usd.Stage.Open(str(file))


def prims(stage: Usd.Stage) -> list[Usd.Prim]:
    """Those of the blocks in order, loaded or not."""
    return list(stage.GetPrimAtPath(BLOCKS).GetAllChildren())


def in_the_drive(prim: Usd.Prim, code: float | None = None) -> np.ndarray:
    """The centres (n, 3) of the Gaussians of a prim in the world of the stage, by default without a time."""
    code = Usd.TimeCode.Default() if code is None else code
    matrix = np.array(UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(code))
    positions = UsdVol.ParticleField3DGaussianSplat(prim).GetPositionsAttr().Get(code)
    return np.array(positions, dtype=np.float64) @ matrix[:3, :3] + matrix[3, :3]


def test_a_stage_without_payloads_is_small_and_knows_where_its_blocks_lie(file, blocks):
    empty = Usd.Stage.Open(str(file), Usd.Stage.LoadNone)
    assert not [prim for prim in empty.Traverse() if prim.IsA(UsdVol.ParticleField)]
    assert [prim.GetDisplayName() for prim in prims(empty)] == blocks.names
    cache = UsdGeom.BBoxCache(Usd.TimeCode.Default(), [UsdGeom.Tokens.default_], useExtentsHint=True)
    hints = [cache.ComputeWorldBound(prim).ComputeAlignedRange() for prim in prims(empty)]
    for number, prim in enumerate(prims(empty)):
        moves = UsdGeom.Xformable(prim).GetLocalTransformation()
        assert np.array(moves.ExtractTranslation()) == pytest.approx(blocks.blocks[number].origin)
        lower, upper = np.array(hints[number].GetMin()), np.array(hints[number].GetMax())
        path = blocks.blocks[number].path
        assert (lower[:2] < path.min(axis=0)).all() and (path.max(axis=0) < upper[:2]).all()
        prim.Load()
        inside = [in_the_drive(own) for own in Usd.PrimRange(prim) if own.IsA(UsdVol.ParticleField)]
        every = np.concatenate(inside)
        assert len(every) > 10 and (lower <= every).all() and (every <= upper).all()
        loaded = [own.IsLoaded() for own in prims(empty)]
        assert loaded == [True] * (number + 1) + [False] * (2 - number), "one is loaded without others"


def test_every_static_gaussian_stands_once_in_the_payload_of_the_nearest_block(stage, blocks):
    found = [in_the_drive(stage.GetPrimAtPath(f"{prim.GetPath()}/background")) for prim in prims(stage)]
    assert sum(map(len, found)) == len(STREET) and min(map(len, found)) >= 8
    every = np.concatenate(found)
    order = [np.lexsort(places.round(3).T) for places in (every, STREET)]
    np.testing.assert_allclose(every[order[0]], STREET[order[1]], atol=1e-5)
    for number, places in enumerate(found):
        apart = [np.linalg.norm(places[:, None, :2] - own.path, axis=2).min(axis=1) for own in blocks.blocks]
        assert (apart[number] <= np.min(apart, axis=0) + 1e-6).all()


def visible(stage: Usd.Stage, track: str, code: Usd.TimeCode) -> list[Usd.Prim]:
    """The prims of an object that are visible at a time code."""
    found = (prim for prim in stage.Traverse() if prim.GetCustomDataByKey("drivesplat:track") == track)
    imageable = (UsdGeom.Imageable(prim) for prim in found)
    return [one.GetPrim() for one in imageable if one.ComputeVisibility(code) != UsdGeom.Tokens.invisible]


@pytest.mark.parametrize("track", TRAJECTORIES)
def test_an_object_is_visible_once_at_the_place_and_time_of_the_drive(stage, tiny_scene, blocks, track):
    """Time codes are thirtieths of seconds since the drive's first image, in all blocks."""
    start, trajectory, shown = min(frame.timestamp for frame in tiny_scene.frames), TRAJECTORIES[track], set()
    end = tiny_scene.seconds(blocks.blocks[-1].core[0, 1])
    for seconds in np.random.default_rng(0).uniform(0.0, end - 1e-3, 80):
        now = visible(stage, track, seconds * 30.0)
        assert len(now) == trajectory.is_there(seconds), seconds
        for prim in now:
            number = blocks.at(start + round(seconds * 1e6))
            assert prim.GetPath().pathString.startswith(str(prims(stage)[number].GetPath()))
            pose = trajectory.pose(seconds)
            expected = own_gaussians(track, 0.0).means.double().numpy() @ pose[:3, :3].T + pose[:3, 3]
            np.testing.assert_allclose(in_the_drive(prim, seconds * 30.0), expected, atol=1e-3)
            shown.add(number)
    assert len(shown) > 1
    middle = tiny_scene.seconds(tiny_scene.frames[len(tiny_scene.frames) // 2].timestamp)
    assert len(visible(stage, track, Usd.TimeCode.Default())) == trajectory.is_there(middle)


def test_the_camera_has_the_path_of_the_whole_drive_and_the_validators_find_nothing(stage, file, tiny_scene):
    camera, expected = UsdGeom.Camera(stage.GetPrimAtPath("/World/camera")), recorded_cameras(tiny_scene, "CAM_FRONT")
    for seconds, one in expected[::7]:
        assert Gf.IsClose(camera.GetCamera(seconds * 30.0).transform, one.transform, 1e-9)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == pytest.approx(
        (expected[0][0] * 30, expected[-1][0] * 30)
    )
    note = stage.GetRootLayer().customLayerData["drivesplat"]
    assert list(note["origin"]) == tiny_scene.origin.tolist() and note["code_sha256"] == "b" * 64
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetErrorAsString() for error in errors] == []
    layers, _, unresolved = UsdUtils.ComputeAllDependencies(str(file))
    assert len(layers) == 4 and not unresolved
    assert str(file.parent).encode() not in file.read_bytes(), "no path of the machine"
    assert sorted(path.name for path in (file.parent / "usd").iterdir()) == [f"0001.00{i}.usdc" for i in range(3)]


def test_places_of_a_block_that_is_left_out_go_to_its_neighbours(tmp_path, tiny_scene, blocks, monkeypatch, capfd):
    exported(tmp_path, tiny_scene, blocks, monkeypatch)
    file = exported(tmp_path, tiny_scene, blocks, monkeypatch, JOB.model_copy(update={"left_out": (1,)}))
    assert sorted(path.name for path in (tmp_path / "usd").iterdir()) == ["0001.000.usdc", "0001.002.usdc"]
    assert capfd.readouterr().err == "", "OpenUSD has nothing to warn of"
    stage = Usd.Stage.Open(str(file))
    assert [prim.GetDisplayName() for prim in prims(stage)] == ["0001.000", "0001.002"]
    static = [in_the_drive(stage.GetPrimAtPath(f"{prim.GetPath()}/background")) for prim in prims(stage)]
    assert sum(map(len, static)) == len(STREET)
    inside = tiny_scene.seconds(int(blocks.blocks[1].core[0].mean()))
    for track in TRAJECTORIES:
        assert visible(stage, track, inside * 30.0) == [], "no block shows that time"


def test_each_payload_is_thinned_and_a_time_after_the_drive_is_refused(tmp_path, tiny_scene, blocks, monkeypatch):
    file = exported(tmp_path, tiny_scene, blocks, monkeypatch, JOB.model_copy(update={"gaussians": 5}))
    stage = Usd.Stage.Open(str(file))
    for prim in prims(stage):
        own = [one for one in Usd.PrimRange(prim) if one.IsA(UsdVol.ParticleField)]
        assert sum(len(UsdVol.ParticleField3DGaussianSplat(one).GetPositionsAttr().Get()) for one in own) == 5
        assert prim.GetCustomDataByKey("drivesplat:gaussians") == 5
    with pytest.raises(ConfigError, match=r"export.time_s is 99.0, but the last image of scene 0001"):
        exported(tmp_path, tiny_scene, blocks, monkeypatch, JOB.model_copy(update={"time_s": 99.0}))
