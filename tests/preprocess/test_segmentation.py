"""Maps by a network: label sets, networks of both libraries, weights that are missing or foreign, and the maps."""

import dataclasses
import json
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.tiny_networks import save_mask2former, save_onnx, save_upernet
from PIL import Image

from benchmarks.segmentation import OF_WORLDS, TrueMaps, page_of
from drivesplat.cli.__main__ import main
from drivesplat.errors import ConfigError, DatasetError, DriveSplatError
from drivesplat.preprocess.segmentation.label_sets import _LABELS, CLASSES, SKY, LabelSet, class_of, label_set
from drivesplat.preprocess.segmentation.maps import MapsRecord, agreed_regions, image_key, make_maps, open_network
from drivesplat.preprocess.segmentation.network import Network, NetworkInput
from drivesplat.preprocess.segmentation.transformer_network import network_input
from drivesplat.preprocess.segmentation.weights import KNOWN, fetch, needed_files, weights_digest
from drivesplat.scene.images import read_image, target_size, write_png
from drivesplat.scene.masks import UNLABELLED, mask_name
from drivesplat.scene.regions import LABELS, label_image
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.segment import DEFAULT_MODEL, SegmentJob, local_path, model_name
from drivesplat.world.shapes.mesh import SurfaceClass

CPU = DeviceSettings(kind="cpu")
COUNTS = {"cityscapes": 19, "mapillary": 65, "ade20k": 150}
RED_OR_BLUE = np.zeros((19, 3))
RED_OR_BLUE[SKY, 2], RED_OR_BLUE[CLASSES.index("car"), 0] = 1.0, 1.0
"""Weights of a network that calls what is blue the sky and what is red a car, else what comes first a road."""


def job(model: str | Path = "any/name", **settings) -> SegmentJob:
    return SegmentJob.model_validate({"model": str(model), "labels": None, "height": 64, "images": {}, **settings})


def names_of(name: str) -> list[str]:
    """The labels of a set with their names in it; those without a class are called otherwise."""
    found = [f"thing {number}" for number in range(COUNTS[name])]
    for labels in _LABELS[name].values():
        for label, number in labels.items():
            found[number] = label.title()
    return found


@pytest.mark.parametrize("name", COUNTS)
def test_labels_have_the_same_classes_by_number_and_by_name(name):
    by_number, by_name = label_set("m", COUNTS[name]), label_set("m", COUNTS[name], names_of(name))
    np.testing.assert_array_equal(by_number.classes, by_name.classes)
    assert (by_number.name, by_name.name) == (name, "own") and len(by_number) == COUNTS[name]
    assert list(by_number.classes).count(SKY) == 1
    assert {"road", "building", "person", "car", "bus"} <= {CLASSES[c] for c in by_number.classes if c != UNLABELLED}
    numbers = [number for labels in _LABELS[name].values() for number in labels.values()]
    assert len(set(numbers)) == len(numbers) and max(numbers) < COUNTS[name]


def test_numbers_of_labels_are_those_of_the_datasets():
    """Some that their makers document."""
    for name, expected in {
        "cityscapes": {0: "road", 10: "sky", 13: "car", 18: "bicycle"},
        "mapillary": {0: None, 13: "road", 27: "sky", 55: "car", 64: None},
        "ade20k": {2: "sky", 6: "road", 12: "person", 20: "car", 3: None, 149: None},
    }.items():
        classes = label_set("m", COUNTS[name]).classes
        for number, label in expected.items():
            assert classes[number] == (UNLABELLED if label is None else CLASSES.index(label)), (name, number)


@pytest.mark.parametrize(
    ("label", "expected"),
    [
        ("bed ", None), ("sky", "sky"), ("building;edifice", "building"), ("traffic_light", "traffic light"),
        ("Lane Marking (only) - Dashed Line", "road"), ("Traffic Sign - Direction (Front)", "traffic sign"),
    ],
)  # fmt: skip
def test_a_label_is_found_by_its_first_name(label, expected):
    assert class_of(label) == expected


def test_labels_of_no_known_set_are_refused():
    with pytest.raises(ConfigError, match=r"m has 21 labels, none of them called sky; known .*cityscapes \(19\)"):
        label_set("m", 21, [f"thing {i}" for i in range(21)])
    with pytest.raises(ConfigError, match=r"segment.labels: ade20k has 150 labels, and m has 19; name another"):
        label_set("m", 19, None, "ade20k")
    assert label_set("m", 66).name == "mapillary"
    few = label_set("m", 3, ["void", "car", "sky"])
    assert few.classes.tolist() == [UNLABELLED, CLASSES.index("car"), SKY]


@pytest.fixture(scope="module")
def upernets(tmp_path_factory) -> dict[str, Path]:
    """A tiny network of the default's architecture for each label set."""
    folder = tmp_path_factory.mktemp("networks")
    return {name: save_upernet(folder / name, count) for name, count in COUNTS.items()}


@pytest.mark.parametrize("name", COUNTS)
def test_a_network_of_each_label_set_labels_every_pixel(upernets, name):
    """As its own logits at the input's size say, computed here without the class."""
    from transformers import UperNetForSemanticSegmentation

    network = open_network(job(upernets[name]), CPU)
    images = np.random.default_rng(0).integers(0, 256, (2, 64, 128, 3), dtype=np.uint8)
    found = network.segment(images, (128, 64))
    model = UperNetForSemanticSegmentation.from_pretrained(upernets[name]).eval()
    mean, std = (torch.tensor(v)[:, None, None] for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225)))
    with torch.inference_mode():
        logits = model((torch.from_numpy(images).permute(0, 3, 1, 2) / 255.0 - mean) / std).logits
    assert network.labels.name == name and logits.shape[1] == COUNTS[name] and len(np.unique(found)) > 2
    np.testing.assert_array_equal(found, logits.argmax(1).numpy())


def test_a_mask2former_labels_every_pixel_by_its_queries(tmp_path):
    network = open_network(job(save_mask2former(tmp_path / "m", names_of("mapillary"))), CPU)
    images = np.random.default_rng(0).integers(0, 256, (1, 64, 64, 3), dtype=np.uint8)
    found = network._model(pixel_values=network.taken.prepare(images, torch.device("cpu")))
    of_labels, masks = found.class_queries_logits[0].softmax(-1), found.masks_queries_logits[0].sigmoid()
    expected = sum(of_labels[q, :-1, None, None] * masks[q] for q in range(5))
    assert network.labels.name == "own" and len(network.labels) == 65
    torch.testing.assert_close(network.scores(network.taken.prepare(images, torch.device("cpu")))[0], expected)
    assert network.segment(images, (30, 20)).shape == (1, 20, 30)


@pytest.mark.parametrize(("size", "batch"), [(None, None), ((64, 32), 1)])
def test_an_onnx_file_labels_pixels(tmp_path, size, batch):
    network = open_network(job(save_onnx(tmp_path / "net.onnx", RED_OR_BLUE, size, batch)), CPU)
    images = np.zeros((2, 64, 128, 3), dtype=np.uint8)
    images[:, :32], images[1, 32:, 64:] = (0, 0, 255), (255, 0, 0)
    expected = np.full((2, 64, 128), 0)
    expected[:, :32], expected[1, 32:, 64:] = SKY, CLASSES.index("car")
    assert network.labels.name == "cityscapes"
    assert (network.segment(images, (128, 64)) == expected).mean() > 0.95, "borders are interpolated"
    assert network.taken.size_of(128, 64) == (size or (128, 64))


def test_the_digest_of_a_network_is_of_its_weights_and_of_the_size_of_its_images(upernets, tmp_path):
    first = open_network(job(upernets["cityscapes"]), CPU)
    other = save_upernet(tmp_path / "other", 19, seed=1)
    digests = {open_network(job(upernets["cityscapes"], height=96), CPU).digest, open_network(job(other), CPU).digest}
    assert first.digest not in digests and len(digests) == 2
    assert open_network(job(upernets["cityscapes"]), CPU).digest == first.digest
    assert weights_digest([upernets["cityscapes"] / "config.json"]) != weights_digest([other / "config.json"], 64)


def test_the_size_of_a_networks_images(tmp_path):
    assert NetworkInput(height=512).size_of(1600, 900) == (896, 512)
    assert NetworkInput(height=70).size_of(96, 54) == (128, 64) and network_input(tmp_path, None) == NetworkInput()
    stated = {"image_mean": [0.5, 0.5, 0.5], "image_std": [0.5, 0.5, 0.5], "size": {"height": 640, "width": 480}}
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(stated))
    assert network_input(tmp_path, None) == NetworkInput((0.5,) * 3, (0.5,) * 3, (480, 640))
    assert network_input(tmp_path, 64).size_of(1600, 900) == (128, 64)
    (tmp_path / "preprocessor_config.json").write_text(json.dumps({"size": {"shortest_edge": 256}}))
    assert network_input(tmp_path, None).size_of(512, 256) == (512, 256)
    (tmp_path / "preprocessor_config.json").write_text("{}")
    assert network_input(tmp_path, None, 96).size_of(1600, 900) == (96, 96)
    assert network_input(tmp_path, 64, 96).size_of(1600, 900) == (128, 64)
    (tmp_path / "preprocessor_config.json").write_text("{")
    with pytest.raises(ConfigError, match=r"segment.model: .*preprocessor_config.json is damaged"):
        network_input(tmp_path, None)


def test_a_network_of_one_size_asks_for_it(upernets, monkeypatch):
    """A BEiT of some versions of transformers refuses all sizes but that of its training."""

    def refuse(pixel_values):
        raise ValueError("Input image size doesn't match model")

    images = np.zeros((1, 32, 64, 3), dtype=np.uint8)
    network = open_network(job(upernets["ade20k"], height=96), CPU)
    monkeypatch.setattr(network, "_model", refuse)
    with pytest.raises(DriveSplatError, match=r"takes no images of 192x96 pixels; set segment.height to null, or"):
        network.segment(images, (64, 32))


def test_weights_that_are_not_here_are_named_with_the_command_that_fetches_them(monkeypatch, tmp_path):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    with pytest.raises(DriveSplatError) as raised:
        open_network(job(DEFAULT_MODEL), CPU)
    assert str(raised.value) == (
        f"segment.model: the weights of {DEFAULT_MODEL} are not on this machine; fetch them with "
        f"`drivesplat segment fetch {DEFAULT_MODEL}`"
    )
    with pytest.raises(ConfigError, match=r"neither a folder, nor an \.onnx file, nor a name on Hugging Face"):
        open_network(job("a//b"), CPU)


def test_fetched_weights_are_found_without_a_network(monkeypatch, upernets, tmp_path):
    """In the layout of Hugging Face's cache."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    folder = tmp_path / f"models--{DEFAULT_MODEL.replace('/', '--')}"
    (folder / "refs").mkdir(parents=True)
    (folder / "refs/main").write_text("0" * 40)
    shutil.copytree(upernets["ade20k"], folder / "snapshots" / ("0" * 40))
    monkeypatch.setattr("socket.socket.connect", None)
    network = open_network(job(DEFAULT_MODEL), CPU)
    assert network.labels.name == "ade20k" and network.digest == open_network(job(upernets["ade20k"]), CPU).digest


@pytest.mark.parametrize(("package", "model"), [("transformers", "folder"), ("onnxruntime", "net.onnx")])
def test_a_missing_package_is_named_with_the_extra(monkeypatch, upernets, tmp_path, package, model):
    path = upernets["cityscapes"] if model == "folder" else save_onnx(tmp_path / model, RED_OR_BLUE)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(DriveSplatError) as raised:
        open_network(job(path), CPU)
    assert str(raised.value) == f"maps by a network need the package {package}: pip install 'drivesplat[segment]'"


def test_files_that_are_no_segmentation_network_are_refused(tmp_path):
    from safetensors.torch import load_file, save_file
    from transformers import ConvNextConfig, ConvNextForImageClassification

    ConvNextForImageClassification(ConvNextConfig(depths=[1] * 4, hidden_sizes=[4] * 4)).save_pretrained(tmp_path / "c")
    headless = save_upernet(tmp_path / "headless", 19)
    weights = load_file(headless / "model.safetensors")
    kept = {name: values for name, values in weights.items() if "classifier" not in name}
    save_file(kept, headless / "model.safetensors", metadata={"format": "pt"})
    assert len(kept) < len(weights)
    (tmp_path / "damaged.onnx").write_bytes(b"no network")
    (tmp_path / "empty").mkdir()
    for name, said in {
        "c": "cannot be opened as a network that segments images",
        "headless": "has no weights of some layers",
        "damaged.onnx": "cannot be opened by onnxruntime",
        "absent.onnx": "there is no .*absent.onnx; name a folder",
        "empty": "is no model: it has no config.json with weights",
    }.items():
        with pytest.raises(ConfigError, match=f"^segment.model: .*{said}"):
            open_network(job(tmp_path / name), CPU)


def test_a_path_is_no_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    assert local_path("mine") == Path("mine") and local_path("net.onnx") == Path("net.onnx")
    assert local_path("owner/name") is None and local_path("~/x") == Path("~/x").expanduser()
    assert local_path("default") is None and model_name("default") == DEFAULT_MODEL and DEFAULT_MODEL in KNOWN


class Hub:
    """In place of Hugging Face's: the files of a model, and which of them were asked for."""

    def __init__(self, folder: Path, files: list[str]):
        self.folder, self.files, self.patterns = folder, files, None

    def list_repo_files(self, model: str) -> list[str]:
        if model != "a/b":
            raise OSError("404: no such model\nand more")
        return self.files

    def snapshot_download(self, model: str, allow_patterns: list[str]) -> str:
        self.patterns = allow_patterns
        return str(self.folder)


@pytest.fixture
def hub(monkeypatch, tmp_path) -> Hub:
    files = ["config.json", "README.md", "model.safetensors", "pytorch_model.bin", "onnx/model.onnx"]
    made = Hub(tmp_path, files)
    monkeypatch.setattr("huggingface_hub.HfApi", lambda: made)
    monkeypatch.setattr("huggingface_hub.snapshot_download", made.snapshot_download)
    return made


def test_a_fetch_takes_settings_and_weights_in_one_format(hub, capsys):
    assert main(["segment", "fetch", "a/b"]) == 0
    assert hub.patterns == ["model.safetensors", "config.json"]
    said = capsys.readouterr().out
    assert said.startswith("a/b: https://huggingface.co/a/b states the licence of these weights")
    assert "to use it, write segment: {model: a/b}" in said
    assert needed_files(["pytorch_model.bin", "config.json"]) == ["pytorch_model.bin", "config.json"]
    hub.files = ["config.json", "tf_model.h5"]
    with pytest.raises(DriveSplatError, match=r"it has no config\.json with weights"):
        fetch("a/b")


def test_a_fetch_that_fails_says_what_else_can_be_done(hub, capsys):
    assert main(["segment", "fetch"]) == 1
    said = capsys.readouterr()
    assert said.out == (
        "openmmlab/upernet-convnext-small: the weights are under the licence MIT (328 MB); they were trained on "
        "ADE20K, whose images may be used for non-commercial research and education alone: whether that limits their "
        "use is for you to decide\n"
    )
    assert said.err == (
        "drivesplat: openmmlab/upernet-convnext-small cannot be fetched (404: no such model); check its name and the "
        "network, or copy its files from another machine and name their folder as segment.model\n"
    )


class Striped(Network):
    """The upper third of every image is sky, then building, then car; it counts the images that it has seen."""

    def __init__(self, digest: str = "striped"):
        super().__init__(LabelSet("cityscapes", np.arange(19, dtype=np.uint8)), digest, batch=3)
        self.seen: list[int] = []

    def segment(self, images, size):
        self.seen.append(len(images))
        stripes = np.repeat([SKY, CLASSES.index("building"), CLASSES.index("car")], -(-size[1] // 3))[: size[1]]
        return np.broadcast_to(stripes[None, :, None], (len(images), size[1], size[0])).astype(np.uint8).copy()


def test_maps_of_every_image_are_written_and_labels_are_reused(tiny_scene, tmp_path):
    """By any run with the same network, images and size; the folder of former settings is removed."""
    network, folder, cache = Striped(), tmp_path / "segmented", tmp_path / "cache"
    record = make_maps(tiny_scene, job(), network, folder, cache)
    count = len(tiny_scene.frames)
    assert sum(network.seen) == count and max(network.seen) == 3 and record.reused == 0
    for frame in tiny_scene.frames:
        size = target_size(frame, job().images)
        pngs = {kind: folder / job().folder / mask_name(kind, frame.camera, frame.timestamp) for kind in KINDS}
        maps = {kind: np.asarray(Image.open(path)) for kind, path in pngs.items()}
        third = size[1] // 3
        assert (maps["sky"][:third] == 255).all() and not maps["sky"][third:].any()
        assert (maps["semantic"][:third] == UNLABELLED).all() and (maps["semantic"][-1] == CLASSES.index("car")).all()
        assert (maps["vehicles"][-third:] == 255).all() and not maps["vehicles"][: 2 * third].any()
        classes = np.where(maps["sky"] > 0, np.uint8(SKY), maps["semantic"])
        expected = agreed_regions(label_image(tiny_scene, frame, size), classes)
        np.testing.assert_array_equal(maps["regions"], expected)
    assert record.sky_share == pytest.approx(1 / 3, abs=0.02) and record.unlabelled_share == 0.0
    again = make_maps(tiny_scene, job(model="another/name"), network, folder, cache)
    assert again.reused == count and sum(network.seen) == count
    assert [path.name for path in folder.iterdir()] == [again.folder] != [record.folder]
    other = Striped("of other weights")
    assert make_maps(tiny_scene, job(), other, folder, cache).reused == 0 and sum(other.seen) == count


KINDS = ("sky", "semantic", "vehicles", "regions")


def test_damaged_labels_in_the_cache_are_computed_again(tiny_scene, tmp_path):
    scene, network = dataclasses.replace(tiny_scene, frames=tiny_scene.frames[:2]), Striped()
    make_maps(scene, job(), network, tmp_path / "maps", tmp_path / "cache")
    next((tmp_path / "cache").glob("*.png")).write_bytes(b"damaged")
    assert make_maps(scene, job(), network, tmp_path / "maps", tmp_path / "cache").reused == 1
    assert network.seen == [2, 1]
    absent = dataclasses.replace(scene.frames[0], image_path=str(tmp_path / "absent.jpg"))
    with pytest.raises(DatasetError, match=r"image .*absent.jpg cannot be read \(No such file"):
        image_key(absent, job(), network)


def test_a_scene_without_any_sky_is_reported(tiny_scene, tmp_path, caplog):
    scene = dataclasses.replace(tiny_scene, frames=tiny_scene.frames[:1])
    network = Striped()
    network.segment = lambda images, size: np.zeros((1, size[1], size[0]), dtype=np.uint8)
    record = make_maps(scene, job("a/b"), network, tmp_path / "maps", tmp_path / "cache")
    assert record.sky_share == 0.0 and isinstance(record, MapsRecord)
    assert f"scene {scene.name}: a/b sees no sky" in caplog.text


def test_regions_leave_out_what_boxes_and_map_contradict():
    road, car, person = (CLASSES.index(name) for name in ("road", "car", "person"))
    boxes = ["static", "static", "moving_car", "moving_car", "moving_car", "still_human", "moving_human", "other"]
    seen = [road, car, car, road, UNLABELLED, person, SKY, road]
    agreed = agreed_regions(
        np.array([[LABELS[name] for name in boxes]], dtype=np.uint8), np.array([seen], dtype=np.uint8)
    )
    names = {number: name for name, number in LABELS.items()}
    assert [names[label] for label in agreed[0].tolist()] == [
        "static", "left_out", "moving_car", "left_out", "moving_car", "still_human", "left_out", "other"
    ]  # fmt: skip


def test_the_stub_of_the_benchmark_gives_the_true_classes_of_a_world(tmp_path):
    """Of images that it knows by their pixels; here two that a world could have made."""
    surfaces = np.array([int(surface) for surface in SurfaceClass if surface is not SurfaceClass.MARKING])
    noise = np.random.default_rng(0)
    images, maps = {}, {}
    for name in ("a", "b"):
        path = tmp_path / f"samples/CAM_FRONT/{name}.jpg"
        true = surfaces[noise.integers(len(surfaces), size=(9, 16))].astype(np.uint8)
        sky = true == SurfaceClass.SKY
        write_png(tmp_path / f"semantic/CAM_FRONT/{name}.png", np.where(sky, np.uint8(UNLABELLED), true))
        write_png(tmp_path / f"sky/CAM_FRONT/{name}.png", np.where(sky, 255, 0).astype(np.uint8))
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(noise.integers(256, size=(9, 16, 3), dtype=np.uint8)).save(path)
        images[name], maps[name] = read_image(path), true
    network, coarse = TrueMaps(tmp_path), TrueMaps(tmp_path, 8)
    assert network.digest != coarse.digest
    classes = network.labels.classes[network.segment(np.stack([images["b"], images["a"]]), (16, 9))]
    for found, name in zip(classes, "ba", strict=True):
        for surface in surfaces:
            named = OF_WORLDS.get(SurfaceClass(surface).name)
            assert (found[maps[name] == surface] == (UNLABELLED if named is None else CLASSES.index(named))).all()
    blocks = coarse.segment(images["a"][None], (16, 8))[0]
    assert len(np.unique(blocks[:, :8])) == len(np.unique(blocks[:, 8:])) == 1


def test_the_page_of_the_benchmark_shows_the_lowest_difference():
    keys = ("sky_iou", "sky_error", "static_psnr", "moving_psnr", "beside_psnr", "train_seconds")
    world = SimpleNamespace(a=dict.fromkeys(keys, 1.0), b={**dict.fromkeys(keys, 1.5), "moving_psnr": None})
    found = {
        "one": {"heuristic": world.a, "sky": world.b},
        "two": {"heuristic": world.a, "sky": dict.fromkeys(keys, 0.75)},
    }
    rows = page_of(found, 3.2).splitlines()
    assert rows[-4].startswith("| mean difference | sky | 0.1250 | 0.1250 | 0.12 | -0.25 |")
    assert rows[-3].startswith("| lowest difference | sky | -0.2500 | -0.2500 | -0.25 | -0.25 |")
