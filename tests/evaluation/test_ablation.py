"""The ablation of a method: its trainings and its tables."""

import csv
import json
import re
from math import sqrt
from pathlib import Path
from typing import Any

import pytest
import yaml
from helpers import REPOSITORY
from helpers.workflow_copy import TINY_TRAINING, WorkflowCopy, complaints

from drivesplat.errors import ConfigError, ResultError
from drivesplat.evaluation.ablation import ablation, markdown, write_csv
from drivesplat.settings.ablation import AblationJob
from drivesplat.settings.config import Config, load, merged
from drivesplat.workflow.plan import Plan
from drivesplat.workflow.stages import stage_settings

LACKING = {
    "actors": {"parts": ["background", "road"]},
    "track_correction": {"train.actors.tracks.corrected": False},
    "sky": {"sky": "none", "train.sky_bce_weight": 0.0},
    "sky_loss": {"train.sky_bce_weight": 0.0},
    "depth": {"train.depth_weight": 0.0},
    "road": {"parts": ["background", "actors"]},
    "ground": {"parts": ["background", "actors"], "train.road_weight": 0.0},
    "dropout": {"train.dropout": 0.0},
    "entropy": {"train.entropy_weight": 0.0},
    "colours_in_time": {"train.actors.fourier": 1},
    "dynamic_loss": {"train.dynamic_weight": 0.0},
}
VARIANTS = tuple(LACKING)


def names(seeds=(0, 1, 2), without=VARIANTS, of="street") -> list[str]:
    """The expected names of an ablation's methods."""
    return [f"{stem}-seed{seed}" for stem in (of, *(f"{of}-without-{name}" for name in without)) for seed in seeds]


def flat(value: Any, path: str = "") -> dict[str, Any]:
    if not isinstance(value, dict):
        return {path.rstrip("."): value}
    return {key: item for name, child in value.items() for key, item in flat(child, f"{path}{name}.").items()}


def training(config: Config, method: str) -> dict[str, Any]:
    """The training settings of a method, by key path."""
    return flat(json.loads(stage_settings(config, "train", "0061", method)))


# --- which methods there are ---


@pytest.mark.parametrize("without", VARIANTS)
def test_a_variant_differs_from_the_method_in_what_it_lacks_only(defaults, without):
    """Every default variant changes a setting; otherwise the method would be compared with itself."""
    seed = 2 if without == "sky" else 0
    street, variant = training(defaults, "street"), training(defaults, f"street-without-{without}-seed{seed}")
    changed = {key: value for key, value in variant.items() if street[key] != value}
    assert street.keys() == variant.keys()
    assert changed == LACKING[without] | ({"random_seed": seed} if seed else {})


@pytest.fixture(scope="module")
def defaults() -> Config:
    return load({})


def with_defaults(**changes: Any) -> dict[str, Any]:
    return merged(yaml.safe_load((REPOSITORY / "config.yaml").read_text(encoding="utf-8")), changes)


def test_users_can_drop_variants_and_add_their_own():
    mine = {"without": {"sky": None, "ssim": {"overrides": {"train": {"ssim_weight": 0.0}}}}}
    config = load(with_defaults(ablation=mine))
    kept = [name for name in VARIANTS if name != "sky"]
    assert list(config.ablated) == names(without=(*kept, "ssim"))
    assert json.loads(stage_settings(config, "ablation", "0061"))["without"] == [*kept, "ssim"]
    assert training(config, "street-without-ssim-seed0")["train.ssim_weight"] == 0.0


# --- what is refused ---


@pytest.mark.parametrize(
    ("section", "words"),
    [
        ({"without": {"x": {}}}, ["ablation.without.x", "removes nothing"]),
        ({"without": {"x": {"overrides": {"train": {"iteration": 3}}}}}, ["ablation.without.x", "train.iteration"]),
        ({"without": {"x": {"overrides": {"holdout": {"offset": 1}}}}}, ["ablation.without.x.overrides.holdout"]),
        ({"without": {"x": {"overrides": {"random_seed": 3}}}}, ["ablation.without.x.overrides.random_seed", "train"]),
        ({"without": {"x": {"parts": ["actors"]}}}, ["ablation.without.x.parts", "lacks 'background'"]),
        ({"without": {"x": {"parts": ["background"] * 2}}}, ["ablation.without.x.parts", "twice"]),
        ({"without": {"x": {"parts": ["wheels"]}}}, ["ablation.without.x.parts", "wheels"]),
        ({"without": {"a/b": {"parts": ["background"]}}}, ["variant", "a/b", "letters"]),
        ({"seeds": []}, ["ablation.seeds", "at least 1"]),
        ({"seeds": [1, 1]}, ["ablation.seeds", "twice"]),
        ({"seeds": [-1]}, ["ablation.seeds", "-1"]),
        ({"seed": [1]}, ["ablation.seed"]),
    ],
    ids=str,
)
def test_errors_in_the_section_are_reported_in_one_line(section, words):
    with pytest.raises(ConfigError) as failure:
        load({"ablation": section})
    message = str(failure.value)
    assert "\n" not in message and all(word in message for word in words), message


def plan(**values: Any) -> Plan:
    return Plan({"datasets": {"a": {"scenes": ["a1"]}}, **values}, str(REPOSITORY))


@pytest.mark.parametrize("target", ["results/a1/ablation.csv", "results/a1/ablation.json"])
def test_variants_without_effect_are_refused_with_the_setting_that_drops_them(target):
    """Vanilla has no actors, no LiDAR depth loss and no sky mask loss: only its sky can be removed. Other results can
    be made."""
    of_vanilla = {"ablation": {"of": "vanilla"}}
    with pytest.raises(ConfigError) as failure:
        plan(**of_vanilla).refuse_unknown([target])
    message, advice = str(failure.value).split("drop them with ")
    assert "\n" not in message and "vanilla" in message and "a1" in message and "nothing" in message
    without = {"without": dict.fromkeys(name for name in VARIANTS if name != "sky")}
    assert yaml.safe_load(advice) == {"ablation": without}
    values = merged(with_defaults(**of_vanilla), {"ablation": without})
    made = plan(**{**values, "datasets": {"a": {"scenes": ["a1"]}}})
    made.refuse_unknown([target])
    assert list(made.config.ablated) == names(of="vanilla", without=["sky"])
    files = ("metrics.json", "street/eval.json", "vanilla-without-sky-seed0/eval.json")
    plan(**of_vanilla).refuse_unknown(["all", *(f"results/a1/{file}" for file in files)])


# --- what it says ---

PROTOCOL = {"width": 640, "holdout": {"every_nth": 8, "offset": 4, "last_block": 4}}


def measured(static: float | None, moving: float | None, beyond: tuple = (None, None), **more: Any) -> dict[str, Any]:
    """An eval.json with these PSNRs for interpolation, and `beyond` for extrapolation."""

    def group(static: float | None, moving: float | None) -> dict[str, Any]:
        gap = None if static is None or moving is None else static - moving
        regions = {"static": static, "moving_vehicle": moving, "all": static}
        return {"gap_db": gap, **{name: None if psnr is None else {"psnr": psnr} for name, psnr in regions.items()}}

    result = {"interpolation": group(static, moving), "extrapolation": group(*beyond)}
    return {
        "scene": "0061", "dataset": "nuscenes", "protocol": PROTOCOL, "drive": {},
        "result": {**result, "gaussians": 1000, "train_seconds": 60.0, **more},
    }  # fmt: skip


JOB = AblationJob(of="street", seeds=(0, 1, 2), without=("sky", "depth"))
WHOLE = [measured(24.0, 20.0), measured(25.0, 21.0), measured(26.0, 20.5)]
SKY = [
    measured(23.0, 20.0, gaussians=900, train_seconds=50.0),
    measured(23.0, 21.5, gaussians=1000, train_seconds=55.0),
    measured(23.0, 22.0, gaussians=1400, train_seconds=60.0),
]
DEPTH = [measured(24.0, 20.0), measured(25.0, 21.0), measured(26.0, 20.5)]


def evals(whole=WHOLE, sky=SKY, depth=DEPTH, job=JOB) -> dict[str, dict[str, Any]]:
    stems = {"street": whole, "street-without-sky": sky, "street-without-depth": depth}
    return {f"{stem}-seed{seed}": found[i] for stem, found in stems.items() for i, seed in enumerate(job.seeds)}


def test_a_row_has_means_standard_deviations_and_differences_paired_by_seed():
    """Static PSNR 24, 25, 26 with the sky and 23 without: differences -1, -2, -3, mean -2, error 1 / sqrt(3)."""
    record = ablation(evals(), JOB)
    assert [record[key] for key in ("scene", "of", "seeds", "protocol")] == ["0061", "street", [0, 1, 2], PROTOCOL]
    whole, sky, depth = record["rows"]
    assert [row["variant"] for row in record["rows"]] == ["street", "street-without-sky", "street-without-depth"]
    assert [(row["without"], row["seeds"]) for row in record["rows"]] == [(None, 3), ("sky", 3), ("depth", 3)]
    static = {"mean": 25.0, "min": 24.0, "max": 26.0, "by_seed": [24.0, 25.0, 26.0]}
    assert whole["interpolation"]["static"] == static
    assert sky["interpolation"]["static"] == {"mean": 23.0, "min": 23.0, "max": 23.0, "by_seed": [23.0] * 3}
    off = sky["interpolation"]["difference"]
    assert (off["static"]["mean"], off["static"]["by_seed"]) == (-2.0, [-1.0, -2.0, -3.0])
    assert off["static"]["standard_error"] == pytest.approx(1.0 / sqrt(3.0))
    assert off["moving_vehicle"]["by_seed"] == [0.0, 0.5, 1.5]
    assert off["moving_vehicle"]["mean"] == pytest.approx(2.0 / 3.0)
    variance = ((2 / 3) ** 2 + (1 / 6) ** 2 + (5 / 6) ** 2) / 2.0
    assert off["moving_vehicle"]["standard_error"] == pytest.approx(sqrt(variance / 3.0))
    assert off["gap_db"]["by_seed"] == [-1.0, -2.5, -4.5]
    assert depth["interpolation"]["difference"]["static"]["mean"] == 0.0
    assert whole["interpolation"]["difference"] == {"static": None, "moving_vehicle": None, "gap_db": None}
    assert (sky["gaussians"]["mean"], sky["gaussians"]["max"], sky["train_seconds"]["mean"]) == (1100.0, 1400, 55.0)


@pytest.mark.parametrize("key", ["protocol", "scene", "dataset"])
def test_results_of_different_protocols_are_not_compared(key):
    other = {**SKY[1], key: {**PROTOCOL, "width": 320} if key == "protocol" else "other"}
    with pytest.raises(ResultError) as failure:
        ablation(evals(sky=[SKY[0], other, SKY[2]]), JOB)
    message = str(failure.value)
    assert "street-without-sky-seed1" in message and key in message and "\n" not in message


def read_csv(path: Path) -> list[dict[str, str]]:
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_the_csv_has_a_line_per_variant_and_empty_cells_for_null(tmp_path):
    write_csv(tmp_path / "ablation.csv", ablation(evals(), JOB))
    whole, sky, depth = read_csv(tmp_path / "ablation.csv")
    of = [f"_{name}" for name in ("min", "max", "difference", "difference_standard_error")]
    assert list(whole) == [
        "scene", "variant", "seeds",
        *(
            f"{group}_{name}{kind}"
            for group in ("interpolation", "extrapolation") for name in ("static", "moving_vehicle", "gap_db")
            for kind in ("", *of)
        ),
        *(f"{name}{kind}" for name in ("gaussians", "train_seconds") for kind in ("", "_min", "_max")),
    ]  # fmt: skip
    assert [row["variant"] for row in (whole, sky, depth)] == ["street", "street-without-sky", "street-without-depth"]
    assert (sky["scene"], sky["seeds"], float(sky["interpolation_static"])) == ("0061", "3", 23.0)
    assert float(sky["interpolation_static_difference"]) == -2.0
    assert float(sky["interpolation_static_difference_standard_error"]) == pytest.approx(1.0 / sqrt(3.0))
    assert float(whole["interpolation_moving_vehicle_max"]) == 21.0
    assert whole["interpolation_static_difference"] == sky["extrapolation_static"] == ""
    assert float(depth["train_seconds_min"]) == 60.0


def test_the_markdown_is_a_table_ready_for_the_documentation():
    text = markdown(ablation(evals(), JOB))
    (block,) = [block for block in text.split("\n\n") if block.startswith("|")]
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in block.splitlines()]
    assert len({len(line) for line in table}) == 1 and set(table[1]) == {"---"}
    assert max(map(len, text.splitlines())) <= 120
    assert table[0] == [
        "without", "static", "difference", "moving vehicles", "difference", "gap", "Gaussians", "training",
    ]  # fmt: skip
    assert table[2] == ["nothing", "25.0 (24.0 to 26.0)", "-", "20.5 (20.0 to 21.0)", "-", "4.5", "1,000", "60 s"]
    assert table[3] == [
        "`sky`", "23.0 (23.0 to 23.0)", "-2.00 ± 0.58", "21.2 (20.0 to 22.0)", "+0.67 ± 0.44", "1.8", "1,100", "55 s",
    ]  # fmt: skip
    assert "0061" in text and "seeds 0, 1, 2" in text and "standard error" in text and "dB" in text
    assert "beyond" not in text.lower(), "a group that was not measured has no table"


# --- through Snakemake ---


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> WorkflowCopy:
    """The workflow with a small ablation: vanilla without its sky, one seed."""
    without = dict.fromkeys(VARIANTS) | {"sky": {"overrides": {"sky": "none"}}}
    section = {"of": "vanilla", "seeds": [2], "without": without}
    train = {**TINY_TRAINING, "iterations": 20}
    return WorkflowCopy.make(tmp_path_factory.mktemp("ablation"), ablation=section, train=train)


def planned_files(copy: WorkflowCopy, target: str, rule: str) -> dict[str, list[str]]:
    """The inputs of every planned job of `rule` in a dry run, by the wildcard `method`."""
    done = copy.run(target, flags=("-n",))
    assert done.returncode == 0, done.stdout
    jobs = re.findall(rf"^(?:local)?rule {rule}:\n((?:    .*\n)+)", done.stdout, re.M)
    fields = [dict(re.findall(r"^    (\w+): (.*)$", job, re.M)) for job in jobs]
    methods = [re.search(r"method=([^, ]+)", job.get("wildcards", "method=")) for job in fields]
    return {m.group(1) if m else "": job["input"].split(", ") for m, job in zip(methods, fields, strict=True)}


@pytest.mark.slow
@pytest.mark.workflow
@pytest.mark.xdist_group("ablation")
def test_the_target_plans_one_training_per_variant_and_seed(copy):
    copy.write_config(yaml.safe_dump({key: value for key, value in copy.config.items() if key != "ablation"}))
    try:
        trainings = planned_files(copy, "results/0001/ablation.csv", "train")
        plain = copy.planned("results/0001/ablation.csv")
        compared = planned_files(copy, "results/0001/ablation.json", "ablation")
        metrics = planned_files(copy, "results/0001/metrics.json", "train")
    finally:
        copy.write_config()
    assert sorted(trainings) == sorted(names())
    for name, files in trainings.items():
        assert ("results/0001/actors.npz" in files) == ("without-actors" not in name), name
        assert ("results/0001/lidar_depth.npz" in files) == ("without-depth" not in name), name
    once = ("extract", "own_car", "lidar_seed", "parser", "masks", "actors", "lidar_depth", "ablation")
    assert plain == {**dict.fromkeys(once, 1), "train": 36, "evaluate": 36}
    assert sorted(compared[""]) == sorted(f"results/0001/{name}/eval.json" for name in names())
    assert sorted(metrics) == ["street", "vanilla"]


@pytest.mark.slow
@pytest.mark.workflow
@pytest.mark.xdist_group("ablation")
def test_the_ablation_runs_to_a_table_and_fails_in_one_line_if_protocols_differ(copy):
    done = copy.run("results/0001/ablation.csv")
    assert done.returncode == 0, done.stdout
    methods = names(seeds=[2], without=["sky"], of="vanilla")
    folders = {path.name for path in (copy.folder / "results/0001").iterdir() if (path / "train.json").is_file()}
    assert folders == set(methods), "the method itself was not asked for"
    for name in methods:
        train = copy.read(f"results/0001/{name}/train.json")
        assert train["random_seed"] == 2
        settings = train["provenance"]["stages"][f"{name}/train"]["settings"]
        assert settings["sky"] == ("none" if "sky" in name else "cubemap")
    record = copy.read("results/0001/ablation.json")
    found = [copy.read(f"results/0001/{name}/eval.json")["result"]["extrapolation"]["static"] for name in methods]
    whole, sky = (row["extrapolation"]["static"]["by_seed"] for row in record["rows"])
    assert whole + sky == [region["psnr"] for region in found]
    assert {f"{name}/train" for name in methods} < record["provenance"]["stages"].keys()
    assert "| `sky` |" in done.stdout
    rows = read_csv(copy.folder / "results/0001/ablation.csv")
    assert [row["variant"] for row in rows] == ["vanilla", "vanilla-without-sky"]
    assert copy.planned("results/0001/ablation.csv") == {}

    path = copy.folder / f"results/0001/{methods[-1]}/eval.json"
    foreign = json.loads(path.read_text())
    foreign["protocol"]["width"] += 1
    path.write_text(json.dumps(foreign))
    done = copy.run("results/0001/ablation.csv")
    assert done.returncode != 0 and "Traceback" not in done.stdout
    lines = complaints(done.stdout)
    assert len(lines) == 1 and methods[-1] in lines.pop()
