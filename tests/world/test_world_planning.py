"""What the workflow knows of a synthetic world: its tables are made, it stays out of the batch, a CPU will do."""

import json
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
from helpers import REPOSITORY
from helpers.demo_worlds import CAMERAS

from drivesplat.errors import ConfigError, DatasetError
from drivesplat.readers.nuscenes.layout import TABLES
from drivesplat.readers.truth import TRUTH_FILE
from drivesplat.settings.config import load
from drivesplat.workflow.plan import Plan


def plan(**config) -> Plan:
    return Plan(config, str(REPOSITORY))


def scene(name: str) -> SimpleNamespace:
    return SimpleNamespace(scene=name)


def test_auto_makes_do_with_the_cpu_for_synthetic_worlds_alone_which_ask_for_little_gpu_memory():
    for written, synthetic in (("auto", "any"), ("any", "any"), ("cuda", "cuda"), ("cpu", "cpu")):
        made = plan(device=written)
        assert [json.loads(made.device(scene(name)))["kind"] for name in ("demo", "0103")] == [synthetic, written]
    told = plan(device={"kind": "cuda", "min_free_gb": 6, "max_gb": 10, "jobs_per_card": 2}).device(scene("demo"))
    assert json.loads(told) == {"kind": "cuda", "min_free_gb": 1.0, "max_gb": 10.0, "jobs_per_card": 2}


@pytest.mark.parametrize(
    ("device", "visible", "demo", "recorded"),
    [("auto", "", 0, 1), ("auto", "0", 1, 1), ("any", "", 0, 0), ("any", "0,1", 1, 1), ("cuda", "", 1, 1),
     ("cpu", "0", 0, 0)],
)  # fmt: skip
def test_trainings_take_a_card_where_they_run_on_one_and_half_the_processors_elsewhere(
    monkeypatch, device, visible, demo, recorded
):
    """A recorded drive is trained on a GPU or not at all, unless told otherwise."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(12)))
    made = plan(device=device)
    assert [made.gpus(scene(name)) for name in ("demo", "0103")] == [demo, recorded]
    threads = made.threads(on_gpu=3)
    assert [threads(scene(name)) for name in ("demo", "0103")] == [3 if demo else 6, 3 if recorded else 6]
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {5})
    assert plan(device="cpu").threads(on_gpu=3)(scene("demo")) == 1


def test_the_demo_is_there_by_default_and_out_of_the_batch():
    config = load({})
    assert config.batch_scenes == [s for s in config.scenes if s != "demo"] != config.scenes
    assert plan().report([]).scenes == config.batch_scenes


def test_a_world_is_known_by_its_dataset_and_alone_has_a_truth(tmp_path):
    """Whatever lies beside recorded tables."""
    datasets = {
        "a": {"dataroot": str(tmp_path / "a"), "scenes": ["a"], "world": {"random_seed": 5}},
        "b": {"dataroot": str(tmp_path / "b"), "version": "v1.0-trainval", "scenes": ["b"], "world": {}},
        "real": {"dataroot": str(tmp_path / "real"), "scenes": ["0001"]},
    }
    for name in (*(f"v1.0-mini/{table}.json" for table in TABLES), TRUTH_FILE):
        (tmp_path / "real" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "real" / name).write_text("[]")
    made = plan(datasets=datasets)
    assert made.worlds == {"a": "a", "b": "b"}
    assert {str(Path(table).parent) for table in made.world_tables("b")} == {f"{tmp_path}/b/v1.0-trainval"}
    told = json.loads(made.world_settings("a"))
    assert (told["scene"], told["world"]["random_seed"]) == ("a", 5)
    assert made.truth(scene("a")) == [f"{tmp_path}/a/{TRUTH_FILE}"] and made.truth(scene("0001")) == []


def test_a_target_that_needs_no_recorded_drive_is_not_refused_for_want_of_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    demo = {"dataroot": "resources/demo", "scenes": ["demo"], "world": {}, "batch": False}
    made = plan(datasets={"nuscenes": {"dataroot": str(tmp_path / "nowhere")}, "demo": demo})
    made.refuse_absent_data(["results/demo/metrics.json", "./results/demo//metrics.json", "resources/x/scene.json"])
    for target in ("./results/0103/metrics.json", "metrics"):
        with pytest.raises(DatasetError, match="nowhere"):
            made.refuse_absent_data([target])


def films() -> Plan:
    """Scenes a and b, of which a alone has a film called aside."""
    aside = {"render": {"trajectories": {"aside": {"lateral": 1.0}}}}
    return plan(datasets={"a": {"scenes": ["a"], "overrides": aside}, "b": {"scenes": ["b"]}})


@pytest.mark.parametrize(
    ("target", "known"),
    [
        ("a/vanilla/nowhere.mp4", "original, lateral_2m, aside"),
        ("a/vanilla/nowhere.cameras.json", "original, lateral_2m, aside"),
        ("b/vanilla/aside.mp4", "original, lateral_2m"),
        ("./b//vanilla/../vanilla/aside.cameras.json", "original, lateral_2m"),
    ],
)
def test_a_film_that_a_scene_does_not_have_is_refused_with_those_it_has(target, known):
    with pytest.raises(ConfigError) as refusal:
        films().refuse_unknown([f"results/{target}"])
    message, name = str(refusal.value), Path(target).name.split(".")[0]
    assert f"has no film called '{name}'; there are: {known} (" in message
    assert "render.trajectories" in message and "\n" not in message


def test_films_that_there_are_and_what_is_no_film_are_not_refused():
    targets = [
        "results/a/vanilla/aside.mp4", "results/b/vanilla/original.cameras.json", "results/b/vanilla/cameras.json",
        "results/b/vanilla/ghost_panel.png", "results/b/vanilla/checkpoint.npz", "results/b/masks/masks.json",
        "results/b/metrics.json", "results/b/vanilla/tensorboard/nowhere.mp4", "elsewhere/b/vanilla/nowhere.mp4",
        "films",
    ]  # fmt: skip
    films().refuse_unknown(targets)


def test_masks_take_two_threads_for_each_camera_and_at_most_eight():
    for cameras, threads in ((0, 1), (1, 2), (3, 6), (6, 8)):
        channels = sorted(CAMERAS)[:cameras]
        made = plan(cameras=channels, eval_camera=channels[0] if channels else None)
        assert made.mask_threads(scene("0103")) == threads
