"""What real logs bring, from tables to metrics and looks as users run it, by both methods: recordings between key
frames, in the dark, with a file missing; a car that stands; a street on which nothing moves."""

import json

import pytest
from tiny_world import World, write_world
from workflow_copy import TINY_TRAINING, WorkflowCopy

from drivesplat.evaluation.in_words import in_words
from drivesplat.masks import NO_SKY

pytestmark = [pytest.mark.workflow, pytest.mark.xdist_group("real_logs")]

HELD_TO_SKY_AND_DEPTH = {"train": {"sky_bce_weight": 0.05, "depth_weight": 0.01}}
METHODS = {"vanilla": {}, "street": {"parts": ["background", "actors"], "overrides": HELD_TO_SKY_AND_DEPTH}}
BETWEEN = {"sweeps": True, "lidar_seed": {"sweeps": True, "max_points": 500}, "extract": {"on_missing": "warn"}}
MISSING = "rich/sweeps/CAM_FRONT/rich__0010.jpg"
SCENES = ("rich", "stands", "still")
CAUTIONS = {
    "rich": "the images are dark",
    "stands": "the car hardly moves (0.0 m in 3.5 s)",
    "still": "no vehicle moves",
}
LOOKS = {
    "stands": ("original.mp4", "lateral_2m.mp4", "ghost_panel.png"),
    "still": ("parts.mp4", "ghost_panel.png", "removal.png"),
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> WorkflowCopy:
    """Three drives of 8 key frames, of the first all but key frame 0 used."""
    worlds = {
        "rich": World(scenes=("rich",), key_frames=8, sweeps_between=5, lidar_between=4, light=0.25),
        "stands": World(scenes=("stands",), key_frames=8, speed=0.0),
        "still": World(scenes=("still",), key_frames=8, things=World().things[1:2]),
    }
    datasets = {name: {"dataroot": name, "scenes": [name]} for name in worlds}
    datasets["rich"] |= {"frames": {"rich": [1, 8]}, "overrides": BETWEEN}
    datasets["still"]["edits"] = {"still": "edits.yaml"}
    copy = WorkflowCopy.make(
        tmp_path_factory.mktemp("real_logs"),
        World(key_frames=2),
        datasets={"nuscenes": {"dataroot": "data", "scenes": ["0001"], "batch": False}, **datasets},
        methods=METHODS,
        holdout={"every_nth": 4, "offset": 2, "last_block": 1},
        actors={"random_points": 200},
        train=TINY_TRAINING | {"iterations": 20},
    )
    for name, world in worlds.items():
        write_world(copy.folder / name, world)
    (copy.folder / MISSING).unlink()
    (copy.folder / "edits.yaml").write_text("edits:\n  gone:\n    - remove: {track: abcd}\n")
    looks = [f"results/{scene}/street/{look}" for scene in LOOKS for look in LOOKS[scene]]
    done = copy.run(*(f"results/{scene}/metrics.json" for scene in SCENES), *looks)
    assert done.returncode == 0, done.stdout
    (copy.folder / "said.txt").write_text(done.stdout)
    return copy


def metrics_of(finished: WorkflowCopy, scene: str) -> dict:
    metrics = finished.read(f"results/{scene}/metrics.json")
    json.dumps(metrics, allow_nan=False)
    return metrics


@pytest.mark.parametrize("scene", SCENES)
def test_each_drive_comes_with_its_caution_and_no_other(finished, scene):
    said = (finished.folder / "said.txt").read_text()
    lines = {line for line in said.splitlines() if line.startswith(f"drivesplat: scene {scene}: ")}
    of_masks = {f"drivesplat: {NO_SKY % scene}"} if scene == "rich" else set()
    assert of_masks <= lines and len(lines - of_masks) == 1
    assert (lines - of_masks).pop().startswith(f"drivesplat: scene {scene}: {CAUTIONS[scene]}")
    assert "Traceback" not in said


def test_images_between_key_frames_are_trained_on_and_the_missing_one_is_counted(finished):
    """Seven key frames are used: 2 and 6 are held out, and of the images between key frames those within a quarter of
    a second of them are excluded: five around the one, two before the other (cameras fire 35 ms early)."""
    protocol = metrics_of(finished, "rich")["protocol"]
    assert protocol["sweeps"] is True and protocol["key_frame_range"] == [1, 8]
    assert protocol["held_out_frames"] == {"interpolation": [2], "extrapolation": [6]}
    scene = finished.read("results/rich/scene.json")
    times = scene["key_frame_timestamps"]
    between = [frame["timestamp"] for frame in scene["frames"] if not frame["is_key_frame"]]
    near = [time for time in between if min(abs(time - times[i]) for i in (2, 6)) < 250_000]
    assert (len(between), len(near), len(scene["sweeps"])) == (29, 7, 31)
    assert protocol["train_images"] == 5 + len(between) - len(near)
    assert protocol["images_missing"] == 1 and protocol["lidar_missing"] == 0


@pytest.mark.parametrize("scene", SCENES)
def test_every_drive_is_measured_by_both_methods(finished, scene):
    methods = metrics_of(finished, scene)["methods"]
    assert set(methods) == {"vanilla", "street"}
    for method in methods.values():
        for group in ("interpolation", "extrapolation"):
            static, moving, vehicle = (method[group][region] for region in ("static", "moving_vehicle", "vehicle"))
            assert static["psnr"] > 8.0 and not (moving and scene == "still")
            other = moving or vehicle
            assert method[group]["gap_db"] == (pytest.approx(static["psnr"] - other["psnr"]) if other else None)


def test_what_the_drives_were_like_stands_beside_their_figures(finished):
    """The tiny drive's key frames are 2 m apart. Of the eight, 2, 6 and 7 are held out; 7 comes after 5."""
    rich, stands, still = (metrics_of(finished, scene)["drive"] for scene in SCENES)
    assert (stands["moved_m"], stands["standing_s"], stands["seconds"]) == (0.0, 3.5, 3.5)
    assert rich["moved_m"] == pytest.approx(12.0) and rich["standing_s"] == 0.0
    for group, metres in (("interpolation", 2.0), ("extrapolation", 4.0)):
        assert stands[group]["from_training_m"] == 0.0
        assert still[group]["from_training_m"] == pytest.approx(metres)
        assert rich[group]["from_training_m"] == pytest.approx(1.0), "a quarter of a second away"
        assert rich[group]["luminance"] < 0.2 < still[group]["luminance"]
        assert rich[group]["flat_psnr"] > still[group]["flat_psnr"] + 6.0


def test_in_words_they_are_read_with_a_grain_of_salt(finished):
    said = {s: "\n".join(in_words(metrics_of(finished, s), f"results/{s}/metrics.json")) for s in SCENES}
    assert said["rich"].count("are dark (mean luminance 0.") == 2 and "remembered" not in said["rich"]
    assert said["stands"].count("were taken 0.00 m from training frames") == 2 and "dark" not in said["stands"]
    assert "no moving vehicle to compare with" in said["still"] and "a gap of" not in said["still"]


def test_where_nothing_moves_looks_say_so_and_an_edit_is_refused_in_a_line(finished):
    for name in ("ghost_panel", "removal"):
        assert "no vehicle moves" in finished.read(f"results/still/street/{name}.json")["why_null"]
    assert finished.read("results/stands/street/ghost_panel.json")["why_null"] is None
    done = finished.run("results/still/street/edits/gone.mp4")
    assert done.returncode != 0 and "Traceback" not in done.stdout
    (line,) = {line for line in done.stdout.splitlines() if line.startswith("drivesplat: ")}
    assert all(words in line for words in ("scene still, edit 'gone'", "nothing can be edited", "something moves"))


def test_a_film_of_a_standing_car_is_a_still_camera_beside_another(finished):
    recorded, beside = (finished.read(f"results/stands/street/{f}.cameras.json") for f in ("original", "lateral_2m"))
    for film in (recorded, beside):
        poses = {json.dumps([[round(x, 6) for x in row] for row in pose]) for pose in film["camera_to_world"]}
        assert len(poses) == 1 and film["frames"] == 15
    first, aside = (film["camera_to_world"][0] for film in (recorded, beside))
    assert [round(a[3] - b[3], 6) for a, b in zip(aside, first, strict=True)] == [0.0, 2.0, 0.0, 0.0]
