"""The configuration: one source, errors in one line, and each stage told of its own settings only."""

import json
import math
import re
from typing import Any

import jsonschema
import pytest
import yaml
from helpers import REPOSITORY

from drivesplat.errors import ConfigError
from drivesplat.settings.config import Config, for_scene, load, merged
from drivesplat.settings.config_document import config_schema, config_yaml, settings_page
from drivesplat.workflow.stages import SCENE_STAGES, TRAINING_INPUTS, stage_settings

LOOKS = (
    "tracks", "film", "compare", "ghost_panel", "remove_actor", "far_gaussians", "export", "export_usd",
    "export_viewer", "export_colmap", "export_spz", "export_sog", "export_alpasim", "lidar_picture", "lidar_film",
    "truth_film",
)  # fmt: skip
OF_SCENES = (
    *SCENE_STAGES, *TRAINING_INPUTS, "scan_baselines", "discover", "relabel", "regions", "segment", "tracks",
    "compare",
)  # fmt: skip
STAGES = (
    *SCENE_STAGES, *TRAINING_INPUTS, "scan_baselines", "discover", "relabel", "regions", "segment", "train",
    "evaluate", *LOOKS,
)  # fmt: skip
PUBLISHED = {"source": "A paper", "url": "https://example.org", "scene": "0061", "method": "M", "psnr": 20.0}


def spelled(values: dict[str, Any] | Config, stage: str, scene: str = "0061", method: str = "vanilla") -> str:
    """The settings of a stage, of a film the one called `original`."""
    config = values if isinstance(values, Config) else load(values)
    film = "original" if stage == "film" else None
    return stage_settings(config, stage, scene, None if stage in OF_SCENES else method, film)


@pytest.fixture(scope="module")
def defaults() -> dict[str, Any]:
    """What Snakemake reads of config.yaml."""
    return yaml.safe_load((REPOSITORY / "config.yaml").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("file", "made"),
    [("config.yaml", config_yaml), ("config.schema.json", config_schema), ("docs/settings.md", settings_page)],
)
def test_files_of_settings_are_what_the_settings_say(file, made):
    text = (REPOSITORY / file).read_text(encoding="utf-8")
    assert text == made(), f"{file} and drivesplat/settings have drifted apart: run `make config`"


def test_config_yaml_holds_the_defaults(defaults):
    assert load(defaults) == load({}) == Config()


def test_config_yaml_fits_two_screens():
    lines = config_yaml().splitlines()
    assert max(map(len, lines)) <= 120 and len(lines) <= 350
    assert len([line for line in lines if re.match(r" *\w+: .", line)]) <= 120


def test_the_page_of_settings_has_every_setting_with_its_meaning():
    page = re.sub(r"\[([\w-]+\.md)\]\(\1\)", r"docs/\1", settings_page())
    rows = {(row[1], row[2]) for row in re.finditer(r"^\| \W*(?:[^`| ]+\.)?(\w+)`.* \| (.*) \|$", page, re.MULTILINE)}
    schema = json.loads(config_schema())
    records = [schema, *schema["$defs"].values()]
    fields = [(name, field) for record in records for name, field in record.get("properties", {}).items()]
    assert len(fields) > 300
    for name, field in fields:
        assert "description" not in field or (name, field["description"].replace("|", "\\|")) in rows, name


def part_of(tree: dict[str, Any]) -> dict[str, Any]:
    """Of each mapping in a tree of settings the first value, and all mappings within it."""
    values = [key for key, value in tree.items() if not isinstance(value, dict)]
    return {
        key: part_of(value) if isinstance(value, dict) else value
        for key, value in tree.items()
        if key in values[:1] or isinstance(value, dict)
    }


def test_what_config_yaml_does_not_print_is_laid_over_the_default_as_if_it_did(defaults):
    """A part of a mapping keeps the rest of it: what YAML would merge, were it printed, the records merge."""
    whole = json.loads(Config().model_dump_json())
    assert load(merged(defaults, part_of(whole))) == load(merged(whole, part_of(whole))) == Config()


STABLE_PATHS = (
    *(f"datasets.nuscenes.{key}" for key in ("reader", "dataroot", "version", "scenes", "frames")),
    *(f"methods.vanilla.{key}" for key in ("parts", "overrides")),
    *(f"holdout.{key}" for key in ("every_nth", "offset", "last_block")),
    *(f"lidar_seed.{key}" for key in ("on_missing", "points_file", "max_points")),
    *(f"train.{key}" for key in ("iterations", "strategy", "cap_max")),
    *(f"render.{key}" for key in ("fps", "width", "height")),
    *("cameras", "sweeps", "sky", "device", "random_seed", "results_dir"),
)


def test_the_stable_setting_paths_are_there(defaults):
    for path in STABLE_PATHS:
        node = defaults
        for key in path.split("."):
            assert key in node, f"the measuring protocol promises {path}"
            node = node[key]


def at(path: str, value: Any) -> dict[str, Any]:
    """{a: {b: value}} of a path 'a.b'."""
    for key in reversed(path.split(".")):
        value = {key: value}
    return value


def refusal(values: dict[str, Any]) -> str:
    with pytest.raises(ConfigError) as failure:
        load(values)
    return str(failure.value)


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        ("trian", {"iterations": 3}, ["trian"]),
        ("datasets.nuscenes.data_root", "x", ["datasets.nuscenes.data_root", "x"]),
        ("train.iterations", 1.5, ["train.iterations", "1.5", "integer"]),
        ("train.cap_max", 10**9, ["train.cap_max", "1000000000", "less than or equal to 20000000"]),
        ("train.strategy", "adc", ["train.strategy", "adc", "'mcmc' or 'default'"]),
        ("train.ssim_weight", math.nan, ["train.ssim_weight", "nan"]),
        ("train", None, ["train", "None"]),
        ("sky", "blue", ["sky", "blue", "'none', 'mask' or 'cubemap'"]),
        ("holdout", {"every_nth": 4, "offset": 5}, ["holdout", "offset", "every_nth (4)"]),
        ("lidar_seed.far_depths", [3.0, -1.0], ["lidar_seed.far_depths", "-1.0", "greater than 0"]),
        ("eval_camera", None, ["eval_camera", "null", "CAM_FRONT"]),
        ("holdout.cameras", ["CAM_BACK"], ["holdout.cameras", "CAM_BACK", "not among cameras"]),
        ("holdout.cameras", ["CAM_FRONT"], ["holdout.cameras", "CAM_FRONT", "eval_camera"]),
        ("methods.vanilla.parts", ["backgruond"], ["methods.vanilla.parts", "backgruond", "background"]),
        ("methods.vanilla.parts", ["actors"], ["methods.vanilla.parts", "lacks 'background'", "add it"]),
        ("methods.vanilla.parts", ["background", "actors", "background"], ["methods.vanilla.parts", "twice"]),
        ("datasets.nuscenes.reader", "kitti", ["datasets.nuscenes.reader", "kitti", "nuscenes"]),
        ("datasets.nuscenes.frames", {"0061": [5, 2]}, ["frames", "0061", "first < last"]),
        ("datasets.nuscenes.frames", {"9999": [1, 2]}, ["frames", "9999", "scenes"]),
        ("eval_camera", "CAM_BACK", ["eval_camera", "CAM_BACK", "CAM_FRONT"]),
        ("datasets.nuscenes.scenes", ["0061", "0103", "0061"], ["datasets.nuscenes.scenes", "twice"]),
        ("datasets.mine.scenes", ["0061"], ["0061", "nuscenes", "mine"]),
        ("render.trajectories", {"lidar": {}}, ["trajectory", "'lidar'", "LiDAR scans"]),
        ("render.trajectories.parts", {"lateral": 1.0}, ["trajectory", "'parts'"]),
    ],
)
def test_an_invalid_value_is_reported_in_one_line_with_key_value_and_range(defaults, path, value, words):
    """Over the whole of config.yaml, as Snakemake reads it: the message names the culprit and not the rest."""
    message = refusal(merged(defaults, at(path, value)))
    assert "\n" not in message
    assert all(word in message for word in words), message
    assert not message.startswith("'' is"), f"a key without a name: {message}"
    assert "far_points" not in message, f"the whole config in a message: {message}"


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("0061", "a number to YAML (which reads 0061 as octal 49)"), ("103", "a number"), ("2011_09_26", "a number"),
        ("12:30:45", "a number"), ("1_0.5", "a number"), ("2024-05-01", "a date"), ("2024-05-01 10:00:00", "a date"),
        ("on", "true or false"), ("~", "nothing"),
    ],
)  # fmt: skip
def test_scene_numbers_without_quotes_are_refused_with_advice_to_quote_them(text, kind):
    """Also what else YAML reads as something else than text; no name is guessed."""
    read = yaml.safe_load(f"['0103', {text}]")
    message = refusal({"datasets": {"nuscenes": {"scenes": read}}})
    advice = f"the name of a scene is {kind}", ": write it in quotes, as it stands in the file"
    assert message.startswith("'datasets.nuscenes.scenes' is ['0103', ") and all(words in message for words in advice)
    keys = refusal({"datasets": yaml.safe_load(f"{{{text}: {{}}}}")})
    kind = kind.partition(" to YAML")[0]
    assert keys == f"'datasets' has the key {read[1]!r}: this key is {kind} to YAML{advice[1]}"


IN_QUOTES = "write it in quotes, as it stands in the file"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        *(
            (
                f"datasets: {{mine: {{scenes: [{scene}]}}}}",
                f"'datasets.mine.scenes' is [{scene}]: the name of a scene must be text, not {scene}",
            )
            for scene in ("{'a': 1}", "['0061']")
        ),
        ("cameras: front", "'cameras' is 'front': it must be a list: ['front']"),
        ("cameras: ~", "'cameras' is None: it must be a list"),
        ("cameras: [12]", f"'cameras.0' is 12: this text is a number to YAML: {IN_QUOTES}"),
        ("train: {1: 2}", f"'train' has the key 1: this key is a number to YAML: {IN_QUOTES}"),
        (
            "methods: {street: {train: {ssim_weight: 0.3}}}",
            "'methods.street.train' does not belong there: 'train' stands at the top level, or under "
            "'methods.street.overrides' for 'methods.street' alone",
        ),
        ("train: {images: {width: 400}}", "'train.images' does not belong there: 'images' stands at the top level"),
    ],
)  # fmt: skip
def test_yaml_that_means_something_else_is_answered_with_what_was_meant(text, message):
    assert refusal(yaml.safe_load(text)) == message


def test_an_unknown_scene_is_refused_with_those_there_are():
    config = load({"datasets": {"a": {"scenes": ["0061", "0103"]}, "b": {"scenes": ["x"]}}})
    with pytest.raises(ConfigError, match=r"'9999'.*0061, 0103, x"):
        config.dataset_of("9999")
    assert (config.dataset_of("0103"), config.dataset_of("x"), config.scenes) == ("a", "b", ["0061", "0103", "x"])


TAKEN = {
    "device": {"kind": "cuda", "min_free_gb": 1},
    "lidar_seed": {"points_file": "a.ply", "far_depths": [1, 2]},
    "datasets": {"nuscenes": {"frames": {"0061": [0, 9]}, "overrides": {"sky": "none"}}},
    "masks": {"own_car_polygons": {"CAM_FRONT": [[0, 0.9], [1, 0.9], [1, 1]]}},
    "methods": {"other": {"overrides": {"train": {"iterations": 9}}}},
    "ablation": {"without": {"x": {"parts": ["background"]}}},
}


def test_what_the_config_takes_its_schema_takes_and_what_it_refuses_is_refused(defaults):
    """Both see the same file: Snakemake validates against the schema once the config has been loaded. YAML reads 1e-3,
    without a point, as text."""
    schema = jsonschema.Draft202012Validator(json.loads(config_schema()))
    texts = ("train: {lr_sky: 1e-3}", 'train: {iterations: "9"}', "sweeps: 'yes'")
    for values in ({}, TAKEN, *map(yaml.safe_load, texts)):
        whole = merged(defaults, values)
        try:
            load(whole)
        except ConfigError:
            assert values not in ({}, TAKEN) and not schema.is_valid(whole), values
        else:
            assert schema.is_valid(whole), values


def test_mappings_are_merged_key_by_key_and_the_rest_is_replaced():
    base = {"a": {"b": 1, "c": {"d": 2}}, "e": [1, 2], "f": {"g": 1}}
    over = {"a": {"c": {"x": 3}}, "e": [3], "f": None, "h": {"i": 1}}
    assert merged(base, over) == {"a": {"b": 1, "c": {"d": 2, "x": 3}}, "e": [3], "f": None, "h": {"i": 1}}
    assert base == {"a": {"b": 1, "c": {"d": 2}}, "e": [1, 2], "f": {"g": 1}}


def stage_record(
    values: dict[str, Any] | Config, stage: str, scene: str = "0061", method: str = "vanilla"
) -> dict[str, Any]:
    return json.loads(spelled(values, stage, scene, method))


def test_overrides_of_a_dataset_reach_the_stages_of_its_scenes_only():
    own = {"images": {"width": 320}, "train": {"mcmc": {"noise_lr": 7.0}}, "cameras": ["CAM_FRONT", "X"]}
    datasets = {"small": {"scenes": ["a"], "overrides": own}, "plain": {"scenes": ["b"]}}
    values = load({"datasets": datasets, "images": {"width": 640}, "train": {"iterations": 99}})
    for stage in ("lidar_seed", "parser", "masks"):
        assert [stage_record(values, stage, scene)["images"]["width"] for scene in "ab"] == [320, 640]
    small, plain = (stage_record(values, "train", scene)["train"] for scene in "ab")
    assert (small["mcmc"]["noise_lr"], small["iterations"]) == (7.0, 99)
    assert small["mcmc"]["refine_every"] == Config().train.mcmc.refine_every
    assert plain["mcmc"]["noise_lr"] == Config().train.mcmc.noise_lr
    assert stage_record(values, "extract", "a")["cameras"] == ["CAM_FRONT", "X"]
    assert stage_record(values, "evaluate", "b")["cameras"] == ["CAM_FRONT"]
    assert stage_record(values, "extract", "a")["dataset"] == "small"


def test_the_shipped_methods_are_first_whatever_order_snakemake_merges_files_in(defaults):
    """Snakemake puts the methods of --configfile before those of config.yaml, and tables would begin with them."""
    shipped = defaults["methods"]
    mine = {"blind": {"tracks": "none"}, "another": {"parts": ["background", "actors"]}}
    assert [*load(defaults | {"methods": {**mine, **shipped}}).methods] == ["vanilla", "street", "blind", "another"]
    street = {"methods": {**mine, "street": shipped["street"]}}
    assert [*load(defaults | street).methods] == ["street", "blind", "another"]


def test_overrides_of_a_method_reach_its_own_stages_only_and_go_over_the_datasets():
    methods = {"vanilla": {}, "no_sky": {"overrides": {"sky": "none", "train": {"iterations": 5}}}}
    values, defaults = load({"methods": methods}), load({})
    assert stage_record(values, "train", method="no_sky")["sky"] == "none"
    assert stage_record(values, "train", method="no_sky")["train"]["iterations"] == 5
    for stage in STAGES:
        expected = stage_record(defaults, stage)
        if stage == "export_viewer":  # its page switches to those of all methods
            expected["methods"] = ["no_sky", "vanilla"]
        assert stage_record(values, stage, method="vanilla") == expected
    dataset = {"overrides": {"sky": "mask", "train": {"iterations": 6, "lr_sky": 0.5}}}
    mine = {"mine": {"overrides": {"train": {"iterations": 7}}}}
    both = stage_record({"datasets": {"nuscenes": dataset}, "methods": mine}, "train", method="mine")
    assert (both["sky"], both["train"]["iterations"], both["train"]["lr_sky"]) == ("mask", 7, 0.5)


def test_datasets_with_equal_overrides_share_the_settings_of_a_scene():
    """Each validation takes milliseconds, and a config may have hundreds of datasets."""
    named = {name: {"scenes": [name], "overrides": {"sky": "none"}} for name in ("a", "b")}
    other = {"scenes": ["c"], "overrides": {"sky": "mask"}}
    config = load({"datasets": {**named, "c": other, "d": {"scenes": ["d"]}}})
    assert [for_scene(config, scene).sky for scene in "abcd"] == ["none", "none", "mask", Config().sky]
    assert for_scene(config, "a", "street") is for_scene(config, "b", "street")
    assert for_scene(config, "a", "street") is not for_scene(config, "c", "street")


@pytest.mark.parametrize(
    ("where", "overrides", "words"),
    [
        ("methods.vanilla", {"train": {"iterations": 0}}, ["train.iterations", "0", "greater than or equal to 1"]),
        ("methods.vanilla", {"holdout": {"every_nth": 0}}, ["methods.vanilla.overrides.holdout", "sky, train"]),
        ("datasets.nuscenes", {"images": {"widht": 9}}, ["images.widht", "9"]),
        ("datasets.nuscenes", {"lpips": {"enabled": False}}, ["datasets.nuscenes.overrides.lpips", "cameras"]),
        ("datasets.nuscenes", {"cameras": ["CAM_BACK"]}, ["eval_camera", "CAM_BACK"]),
        ("datasets.nuscenes", {"render": {"trajectories": {"parts": {"lateral": 1.0}}}}, ["trajectory", "'parts'"]),
    ],
)
def test_a_bad_override_is_refused_when_the_config_is_loaded(defaults, where, overrides, words):
    message = refusal(merged(defaults, at(f"{where}.overrides", overrides)))
    assert "\n" not in message and f"{where}.overrides" in message
    assert all(word in message for word in words), message
    assert "far_points" not in message, f"the whole config in a message: {message}"


def reversed_keys(value: Any) -> Any:
    return {key: reversed_keys(value[key]) for key in reversed(value)} if isinstance(value, dict) else value


@pytest.fixture(scope="module")
def plain() -> dict[str, str]:
    """The settings of all stages without any given one."""
    return spelled_stages({})


def spelled_stages(values: dict[str, Any]) -> dict[str, str]:
    config = load(values)
    return {stage: spelled(config, stage) for stage in STAGES}


def test_key_order_and_written_out_defaults_do_not_change_the_settings_of_any_stage(defaults, plain):
    for values in (defaults, reversed_keys(defaults), {"train": {"iterations": defaults["train"]["iterations"]}}):
        assert spelled_stages(values) == plain
    written_out = {"sky": defaults["sky"], "train": {"iterations": defaults["train"]["iterations"]}}
    assert spelled_stages(merged(defaults, at("methods.vanilla.overrides", written_out))) == plain


@pytest.mark.parametrize(
    ("change", "readers"),
    [
        (at("cameras", ["CAM_FRONT", "CAM_BACK"]), "extract own_car evaluate"),
        (
            {"cameras": ["CAM_FRONT", "CAM_BACK"], "eval_camera": "CAM_BACK"},
            "extract own_car train evaluate tracks film compare ghost_panel remove_actor export_usd export_viewer "
            "truth_film",
        ),
        (at("sweeps", True), "extract evaluate"),
        (at("images.width", 320), "lidar_seed parser segment masks regions actors lidar_depth evaluate film"),
        (at("holdout.every_nth", 5), "lidar_seed parser masks actors lidar_depth scans evaluate film"),
        (
            at("cameras", ["CAM_FRONT", "CAM_BACK"]) | at("holdout.cameras", ["CAM_BACK"]),
            "extract own_car lidar_seed parser masks actors lidar_depth scans evaluate film",
        ),
        (at("extract.on_missing", "warn"), "extract"),
        (at("lidar_seed.on_missing", "warn"), "lidar_seed scans"),
        (at("lidar_seed.sweeps", True), "extract lidar_seed"),
        (at("lidar_seed.voxel_size", 0.2), "lidar_seed"),
        (at("lidar_seed.own_car_radius", 3), "lidar_seed actors lidar_depth scans evaluate"),
        (at("lidar_seed.box_margin", 0.3), "lidar_seed lidar_depth evaluate"),
        (at("actors.humans", True), "actors tracks"),
        (at("datasets.nuscenes.overrides", {"actors": {"max_points": 9}}), "actors tracks"),
        (at("masks.sky_folder", "sky"), "masks"),
        (at("segment.model", "a/b"), "segment masks"),
        (at("segment", {"use": ["regions"]}), ""),
        (at("segment.height", 64), "segment"),
        (at("masks.own_car_polygons", {"CAM_FRONT": [[0, 0], [1, 1], [0, 1]]}), "own_car masks"),
        (at("lidar_depth.ray_spacing", [1, 1]), "lidar_depth evaluate"),
        (at("scans.azimuth_steps", 1042), "scans"),
        (at("discover.lidar", "LIDAR_TOP"), "discover"),
        (at("sky", "none"), "train"),
        (at("train.iterations", 9), "train"),
        (at("methods.vanilla.overrides", {"train": {"iterations": 9}}), "train"),
        (at("methods.another.overrides", {"train": {"iterations": 9}}), "export_viewer"),
        (at("random_seed", 1), "lidar_seed actors train"),
        (at("lpips.enabled", False), "evaluate"),
        (at("render.fps", 60), "film"),
        (at("render.crf", 20), "film compare lidar_film truth_film"),
        (at("render.lidar", False), ""),
        (at("render.trajectories.original.lateral", 1.0), "film"),
        (at("render.trajectories.aside", {"lateral": -1.0}), ""),
        (at("subjects", {"0061": {"key_frame": 3}}), "ghost_panel remove_actor"),
        (at("subjects", {"0103": {"key_frame": 3}}), ""),
        (at("ghosts.clearance", 0.5), "ghost_panel remove_actor"),
        (at("removal.margin", 0.5), "remove_actor"),
        (at("export.viewer_gaussians", 9), "export_viewer"),
        (at("export.max_distance", 9), "far_gaussians"),
        (at("export.sh_degree", 3), "export"),
        (at("export.formats", ["ply"]), ""),
        (at("published", [PUBLISHED]), ""),
        (at("device", "cpu"), ""),
        (at("results_dir", "elsewhere"), ""),
        (at("datasets.nuscenes.dataroot", "/elsewhere"), ""),
        (at("datasets.nuscenes.version", "v1.0-trainval"), "extract"),
        (at("datasets.nuscenes.frames", {"0061": [0, 9]}), "extract"),
        (at("datasets.nuscenes.scenes", ["0061"]), ""),
        (at("datasets.more.scenes", ["0001"]), ""),
        (at("datasets.nuscenes.overrides", {"masks": {"sky_folder": "sky"}}), "masks"),
    ],
    ids=str,
)
def test_a_setting_reaches_the_stages_that_read_it_and_no_others(defaults, plain, change, readers):
    after = spelled_stages(merged(defaults, with_methods_kept(change)))
    assert {stage for stage in STAGES if plain[stage] != after[stage]} == set(readers.split())


def with_methods_kept(change: dict[str, Any]) -> dict[str, Any]:
    """Whatever a change says of methods, `vanilla` is one of them."""
    return merged({"methods": {"vanilla": {}}}, change)


def test_a_result_among_the_config_files_is_named_as_that(defaults):
    """Snakemake takes a target that is there for one where `--` is missing before it."""
    with pytest.raises(ConfigError, match=r"a result of this workflow is among the config files.*put -- before"):
        load({**defaults, "methods": {"vanilla": {"interpolation": {}}}, "provenance": {"stages": {}}})
