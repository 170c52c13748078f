"""The converter of PandaSet: a small sequence in PandaSet's own layout, compared with the world that it shows; pickles
that it must not execute."""

import copyreg
import gzip
import json
import pickle
import shutil
from pathlib import Path

import numpy as np
import pandas
import pytest
from helpers import REPOSITORY
from helpers.drives import TILTED_CAMERA, TIMES, World, rays_at, seconds_of, seen_from, turning_world
from helpers.mutations import damages, fresh, likely, mutate_file
from helpers.shown_drives import assert_shows, require_refused_or_sound, world_points
from pandas.core.internals.managers import BlockManager
from PIL import Image
from scipy.spatial.transform import Rotation

from drivesplat.errors import DatasetError
from drivesplat.readers.drive.check import check, whole_scene
from drivesplat.readers.drive.format import read_drive
from drivesplat.readers.sweeps import read_returns
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Scene
from examples import pandaset
from examples.pandas_pickle import read_table

LIDAR = rigid(Rotation.from_euler("z", -90, degrees=True).as_matrix(), np.array([0.0, 0.0, 2.1]))
"""In the ego frame: x to the right, y forward."""
FRONT_TURN = Rotation.from_quat([0.0030578899383849464, 0.7114721800418571, -0.7025205466606356, 0.016213200031258722])
FRONT_PLACE = np.array([0.0002585796504896516, -0.03907777167811011, -0.0440125762408362])
FRONT = LIDAR @ inverse(rigid(FRONT_TURN.as_matrix(), FRONT_PLACE))
ELEVATIONS = np.radians(np.linspace(-25.0, 3.0, 8))
SPIN, DELAY = 50_000, 13_000
"""Microseconds of half a revolution, and of the left camera after the front camera."""
LABELS = {"car": "Car", "truck": "Semi-truck", "pedestrian": "Pedestrian with Object"}


def pose_json(pose: np.ndarray) -> dict:
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    position = dict(zip("xyz", pose[:3, 3].tolist(), strict=True))
    return {"position": position, "heading": {"w": w, "x": x, "y": y, "z": z}}


def write_json(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value))


def seen_box(drive: World, thing, time: int) -> np.ndarray:
    """Where an object is when the LiDAR, clockwise from behind, faces it in the revolution around `time`."""
    box = drive.box(thing, time)
    for _ in range(5):
        x, y = seen_from(drive.ego(time), box[None, :3, 3])[0, :2]
        box = drive.box(thing, time - SPIN * np.arctan2(y, x) / np.pi)
    return box


def cuboids(drive: World, time: int) -> pandas.DataFrame:
    """The boxes of a frame; the car has a second one by the forward LiDAR, 3 m beside it."""
    rows = []
    for thing in drive.things:
        is_car, box = thing.category == "car", seen_box(drive, thing, time)
        if not thing.velocity or not np.any(thing.velocity):
            box = drive.box(thing, time)
        length, width, height = thing.size
        row = {
            "uuid": f"uuid {thing.category}",
            "label": LABELS[thing.category],
            "yaw": np.arctan2(box[1, 0], box[0, 0]) - np.pi / 2,
            "stationary": not np.any(thing.velocity),
            "camera_used": -1,
            **dict(zip(("position.x", "position.y", "position.z"), box[:3, 3], strict=True)),
            **{"dimensions.x": width, "dimensions.y": length, "dimensions.z": height},
            "attributes.object_motion": np.nan,
            "cuboids.sibling_id": "front" if is_car else "-",
            "cuboids.sensor_id": 0 if is_car else -1,
        }
        rows.append(row)
        if is_car:
            other = {"uuid": "front", "cuboids.sibling_id": row["uuid"], "cuboids.sensor_id": 1}
            rows.append(row | other | {"position.x": box[0, 3] + 3.0})
    return pandas.DataFrame(rows)


def scan(drive: World, time: int) -> tuple[pandas.DataFrame, np.ndarray]:
    """The table of a revolution, with a return of the forward LiDAR, and the spinning LiDAR's hits (n, 3)."""
    parts, seconds = [], []
    for azimuth in np.radians(np.arange(179.0, -180.0, -6.0)):
        now = time - SPIN * azimuth / np.pi
        parts.append(drive.hits(LIDAR, rays_at(azimuth + np.pi / 2, ELEVATIONS), now))
        seconds += [now * 1e-6] * len(parts[-1])
    hits = np.concatenate(parts)
    table = pandas.DataFrame({"x": hits[:, 0], "y": hits[:, 1], "z": hits[:, 2], "i": 51.0, "t": seconds, "d": 0})
    table.loc[len(table)] = [1.0, 2.0, 3.0, 9.0, time * 1e-6, 1]
    return table.astype({"d": int}), hits


def write_sequence(folder: Path, drive: World, times: np.ndarray) -> Path:
    """A sequence with two cameras, of which the left one shows the drive."""
    for name, mount, delay in (("front_camera", FRONT, 0), ("left_camera", TILTED_CAMERA, DELAY)):
        camera = folder / "camera" / name
        write_json(camera / "poses.json", [pose_json(drive.ego(time + delay) @ mount) for time in times])
        write_json(camera / "timestamps.json", [(time + delay) * 1e-6 for time in times.tolist()])
        (fx, _, cx), (_, fy, cy), _ = drive.intrinsics.tolist()
        write_json(camera / "intrinsics.json", {"fx": fx, "fy": fy, "cx": cx, "cy": cy})
        for i, time in enumerate(times):
            Image.fromarray(drive.image(seconds_of(time + delay), TILTED_CAMERA)).save(
                camera / f"{i:02}.jpg", quality=97
            )
    for name in ("lidar", "annotations/cuboids"):
        (folder / name).mkdir(parents=True)
    for i, time in enumerate(times.tolist()):
        scan(drive, time)[0].to_pickle(folder / f"lidar/{i:02}.pkl.gz", protocol=3)
        cuboids(drive, time).to_pickle(folder / f"annotations/cuboids/{i:02}.pkl.gz", protocol=4)
    return folder


@pytest.fixture(scope="module")
def drive() -> World:
    return turning_world(rigid(Rotation.from_euler("z", 0.65).as_matrix(), np.array([3.0, -7.0, 1.0])))


@pytest.fixture(scope="module")
def sequence(drive, tmp_path_factory) -> Path:
    return write_sequence(tmp_path_factory.mktemp("pandaset") / "001", drive, TIMES)


@pytest.fixture(scope="module")
def short_sequence(drive, tmp_path_factory) -> Path:
    return write_sequence(tmp_path_factory.mktemp("short") / "001", drive, TIMES[:2])


@pytest.fixture(scope="module")
def scene(sequence, tmp_path_factory) -> Scene:
    out = tmp_path_factory.mktemp("drives") / "pandaset"
    assert pandaset.main([str(sequence), str(out), "--cameras", "left_camera"]) == 0
    assert check(out, None) == []
    return whole_scene(read_drive(out), out)


def test_pandaset_shows_the_world_that_it_recorded(scene, drive):
    assert scene.key_frame_timestamps.tolist() == TIMES.tolist()
    assert_shows(scene, drive, DELAY, {"main_pandar64": LIDAR}, atol=5e-3)
    assert [track.category for track in scene.tracks] == list(LABELS.values())
    assert [track.object_class for track in scene.tracks] == ["car", "truck", "pedestrian"]
    assert all(len(track.timestamps) == len(TIMES) for track in scene.tracks)
    table, hits = scan(drive, int(TIMES[2]))
    np.testing.assert_allclose(world_points(scene, 2, drive), hits, atol=2e-3), "those of the spinning LiDAR"
    returns = read_returns(scene.sweeps[2])
    np.testing.assert_allclose(returns.offsets_s, table["t"][:-1] - TIMES[2] * 1e-6, atol=1e-6)
    np.testing.assert_allclose(returns.intensity, 0.2, atol=1e-6)


def test_both_cameras_are_converted_with_the_front_camera_first(sequence, tmp_path, capsys):
    assert pandaset.main([str(sequence), str(tmp_path / "out")]) == 0
    cameras = read_drive(tmp_path / "out").cameras
    assert list(cameras) == ["front_camera", "left_camera"]
    np.testing.assert_allclose(cameras["front_camera"].sensor_to_ego.translation, FRONT[:3, 3])
    assert pandaset.main([str(tmp_path), str(tmp_path / "out")]) == 1
    assert "has no folder front_camera" in capsys.readouterr().err
    assert pandaset.main([str(sequence), str(tmp_path / "out"), "--cameras", "roof"]) == 1
    assert "has no folder roof; there are: front_camera, left_camera" in capsys.readouterr().err


def test_the_recorded_frame_of_pandaset_is_converted(tmp_path):
    recorded = REPOSITORY / "../shared/data/pandaset-frame/001"
    if not recorded.is_dir():
        pytest.skip("the recorded frame is not in ../shared/data/pandaset-frame")
    assert pandaset.main([str(recorded), str(tmp_path / "out")]) == 0
    assert check(tmp_path / "out", None) == []
    converted = whole_scene(read_drive(tmp_path / "out"), tmp_path / "out")
    assert (len(converted.frames), len(converted.tracks)) == (2, 151 - 12)
    assert len(read_returns(converted.sweeps[0]).points) == 106886
    size = {track.id: track.size for track in converted.tracks}["2c4dbdea-845e-4d29-8a94-9c86feb536fe"]
    np.testing.assert_allclose(size, [4.629, 1.867, 1.673])


# Pickles

TABLE = {
    "x": np.arange(3.0),
    "y": np.arange(3.0) + 0.5,
    "d": np.array([0, 1, 0]),
    "label": np.array(["a", None, "ä"], object),
}


class OldManager:
    """Pickled as pandas 0.25 did with its BlockManager."""

    __class__ = property(lambda self: BlockManager)

    def __reduce_ex__(self, protocol):
        numbers, whole = np.stack([TABLE["x"], TABLE["y"]]), TABLE["d"][None]
        text, names = TABLE["label"][None], pandas.Index(list(TABLE))
        blocks = [(numbers, slice(0, 2, 1)), (whole, slice(2, 3, 1)), (text, np.array([3]))]
        axes = [names, pandas.RangeIndex(3)]
        later = {"axes": axes, "blocks": [{"values": values, "mgr_locs": places} for values, places in blocks]}
        return copyreg.__newobj__, (BlockManager,), (axes, [numbers, whole, text], [names], {"0.14.1": later})


class OldFrame:
    __class__ = property(lambda self: pandas.DataFrame)

    def __reduce_ex__(self, protocol):
        return copyreg.__newobj__, (pandas.DataFrame,), {"_data": OldManager(), "_typ": "dataframe", "attrs": {}}


@pytest.mark.parametrize("protocol", [3, 5])
@pytest.mark.parametrize("frame", [pandas.DataFrame(TABLE), pandas.DataFrame(TABLE, index=[7, 5, 6]), OldFrame()])
def test_tables_are_read_as_they_were_written(frame, protocol, tmp_path):
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(frame, protocol=protocol))
    found = read_table(path)
    assert set(found) == set(TABLE)
    for name, values in TABLE.items():
        np.testing.assert_array_equal(found[name], values)
    (tmp_path / "a.pkl.gz").write_bytes(gzip.compress(path.read_bytes()))
    np.testing.assert_array_equal(read_table(tmp_path / "a.pkl.gz")["label"], TABLE["label"])


class Program:
    """Writes a file when it is unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.write_text, (self.path, "executed")


def test_no_pickle_is_executed(tmp_path):
    frame, mark = pandas.DataFrame(TABLE), tmp_path / "mark"
    for value in (
        Program(mark),
        pandas.DataFrame({"x": [Program(mark)]}),
        {"frame": frame, "more": Program(mark)},
        frame.assign(label=[{"a": 1}] * 3),
        frame.x,
        [frame],
        pandas.DataFrame({"t": pandas.to_datetime(["2020-01-01"])}),
    ):
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(value, protocol=4))
        with pytest.raises(DatasetError, match=r"a\.pkl cannot be read as a table of pandas"):
            read_table(tmp_path / "a.pkl")
        assert not mark.exists()
    pickle.loads(pickle.dumps(Program(mark)))
    assert mark.read_text() == "executed", "the test would not see a difference"


class Forged:
    """An array whose bytes do not fit the dtype and shape that the pickle states."""

    def __init__(self, content: bytes, dtype: str, shape: tuple[int, ...]):
        self.arguments = content, np.dtype(dtype), shape, "C"

    def __reduce__(self):
        return np.zeros(1).__reduce_ex__(5)[0], self.arguments


def test_arrays_that_do_not_fit_their_bytes_are_refused(tmp_path):
    for array, reason in (
        (Forged(b"12345678", "O", (1,)), "an array of objects has no bytes"),
        (Forged(b"12345678", "f8", (2,)), "another number of bytes"),
        (Forged(b"", "f8", (-1, 0)), "no shape"),
        (Forged(b"", "f8", (0,) * 9), "no shape"),
        (Forged(b"\2", "?", (1,)), "no truth values"),
        (Forged(b"\xff" * 4, "<U1", (1,)), "no truth values or characters"),
        (Forged(b"12345678", "M8[s]", (1,)), "another dtype"),
    ):
        (tmp_path / "a.pkl").write_bytes(pickle.dumps(array, protocol=4))
        with pytest.raises(DatasetError, match=rf"a\.pkl cannot be read as a table of pandas.*{reason}"):
            read_table(tmp_path / "a.pkl")


@damages(15, 200)
def test_damaged_sequences_are_refused_in_one_line_or_sound(short_sequence, tmp_path, capsys, random):
    files = sorted(path.relative_to(short_sequence) for path in short_sequence.rglob("*") if path.is_file())
    chosen = random.choice([file for file in files if file.name != "00.jpg" or likely(random, 3)])
    with fresh(tmp_path) as folder:
        sequence, out = Path(shutil.copytree(short_sequence, folder / "001")), folder / "out"
        done = f"{chosen.parent} {mutate_file(random, sequence / chosen)}"
        require_refused_or_sound(lambda: pandaset.main([str(sequence), str(out)]), out, capsys, done)
