"""The summary of a metrics.json in sentences."""

import json

from drivesplat.cli.__main__ import main
from drivesplat.evaluation.figures_table import figures_table
from drivesplat.evaluation.summary import sentences


def method(**groups) -> dict:
    empty = {"gap_db": None, "static": None, "moving_vehicle": None}
    return {
        "interpolation": groups.get("interpolation", empty), "extrapolation": groups.get("extrapolation", empty),
        "gaussians": 40000, "train_seconds": 91.4, "device": "cpu (x86_64)",
    }  # fmt: skip


def group(static: float | None, moving: float | None) -> dict:
    gap = static - moving if moving is not None else None
    return {
        "gap_db": gap, "static": {"psnr": static}, "moving_vehicle": {"psnr": moving} if moving is not None else None
    }  # fmt: skip


def test_each_group_is_a_sentence_with_its_gap():
    metrics = {"methods": {"vanilla": method(interpolation=group(27.1, 16.0), extrapolation=group(22.0, 12.5))}}
    lines = sentences(metrics, "results/demo/metrics.json")
    assert "vanilla, frames between training frames: moving vehicles 16.0 dB, static 27.1 dB: a gap of 11.1 dB" in lines
    beyond = "frames beyond the last training frame: moving vehicles 12.5 dB, static 22.0 dB: a gap of 9.5 dB"
    assert f"vanilla, {beyond}" in lines
    assert "vanilla: 40,000 Gaussians, trained in 91 s on cpu (x86_64)" in lines
    figures = next(line for line in lines if line.startswith("All figures: "))
    assert "results/demo/metrics.json" in figures and figures.endswith(" results/demo")


def test_what_was_not_measured_is_not_mentioned_or_said_to_be_missing():
    nothing = "No image is held out (holdout), so there are no figures of held-out images"
    assert sentences({"methods": {"vanilla": method()}}, "m.json")[0] == nothing
    static = sentences({"methods": {"vanilla": method(interpolation=group(27.1, None))}}, "m.json")
    assert static[0].endswith("static 27.1 dB, no moving vehicle to compare with")
    assert nothing not in static and not any("beyond" in line for line in static)


def test_blocks_that_are_left_out_are_named():
    protocol = {"cameras": ["CAM_FRONT"], "left_out": ["way.003", "way.007"]}
    said = "Blocks are left out of the drive, and of all figures: way.003, way.007"
    assert said in sentences({"protocol": protocol, "methods": {"vanilla": method()}}, "m.json")
    none = {"protocol": {**protocol, "left_out": []}, "methods": {"vanilla": method()}}
    assert not any("left out" in line for line in sentences(none, "m.json"))


def test_figures_against_ground_truth_are_reported():
    lateral = {"2.0": {"all": {"psnr": 21.5}, "static": {"psnr": 22.7}}}
    before = {"box": {"psnr": 14.3}, "outside": {"psnr": 25.9}}
    removal = {"box": {"psnr": 17.0}, "outside": {"psnr": 26.2}, "not_removed": before}
    metrics = {"methods": {"vanilla": {**method(), "lateral": lateral, "removal": removal}}}
    lines = sentences(metrics, "m.json")
    assert "vanilla, from 2 m to the left, against truth: static 22.7 dB" in lines
    expected = "vanilla, the car ahead removed, against the empty street: 17.0 dB in its box (14.3 dB before)"
    assert expected in lines


def test_the_command_prints_table_and_summary_and_names_a_missing_or_foreign_file(tmp_path, capsys):
    file = tmp_path / "metrics.json"
    assert main(["show", str(tmp_path)]) == 1
    assert str(file) in capsys.readouterr().err
    file.write_text(json.dumps({"frames": []}))
    assert main(["show", str(tmp_path)]) == 1
    assert f"{file}: not the metrics of a scene" in capsys.readouterr().err
    file.write_text(json.dumps(measured("one", vanilla=method(interpolation=group(27.1, 16.0)))))
    shown = []
    for given in (tmp_path, file):
        assert main(["show", str(given)]) == 0
        shown.append(capsys.readouterr().out)
    assert shown[0] == shown[1]
    assert shown[0].splitlines()[3].split() == ["one", "vanilla", "27.1", "16.0", "11.1"]
    assert "a gap of 11.1 dB" in shown[0]


def measured(scene: str, **methods) -> dict:
    return {"scene": scene, "methods": methods}


def test_the_table_has_the_groups_and_figures_that_any_method_has():
    scans = {**group(26.0, None), "lidar": {"all": {"range_error_median_m": 0.0312}}}
    parked = {**group(25.0, None), "gap_db": 3.0}
    records = [
        measured("a", vanilla=method(interpolation=group(27.1, 16.0)), street=method(interpolation=parked)),
        measured("long_name", lidar=method(interpolation=scans)),
    ]
    legend, groups, headings, *rows = figures_table(records)
    assert "range" in legend and groups.split() == ["between", "training", "frames"]
    assert headings.split() == ["scene", "method", "static", "moving", "gap", "range"]
    cells = [row.split() for row in rows]
    assert cells[0] == ["a", "vanilla", "27.1", "16.0", "11.1", "-"]
    assert cells[1] == ["a", "street", "25.0", "-", "-", "-"], "the gap of parked vehicles is none to close"
    assert cells[2] == ["long_name", "lidar", "26.0", "-", "-", "3.1"]
    assert len({len(line) for line in (groups, headings, *rows)}) == 1, "columns are aligned"
    assert "range" not in figures_table(records[:1])[0]
    assert figures_table([measured("a", vanilla=method())]) == []


def test_rendered_scans_are_compared_with_the_baselines():
    def regions(median: float | None, drops: float | None) -> dict:
        figures = {"range_error_median_m": median, "intensity_rmse": median, "drop_accuracy": drops, "rays": 9}
        return {"all": figures if drops is not None else {**figures, "unavailable": "fewer than 100 measured rays"}}

    nothing = regions(None, None)
    groups = {name: {"gap_db": None, "lidar": one} for name, one in
              (("interpolation", regions(0.031, 0.981)), ("extrapolation", nothing))}  # fmt: skip
    baseline = {"interpolation": regions(0.059, 0.72), "extrapolation": nothing}
    metrics = {"methods": {"mine": {**method(), **groups}}, "lidar_baselines": {"nearest_scan": baseline}}
    lines = sentences(metrics, "m.json")
    assert (
        "mine, LiDAR scans between training frames: range off by 3.1 cm in the median, intensity by 0.031, 98.1 % of "
        "returns and drops right (nearest scan: 5.9 cm, 0.059, 72.0 %)"
    ) in lines
    assert "mine, LiDAR scans beyond the last training frame: no figures, fewer than 100 measured rays" in lines
    assert not any("LiDAR" in line for line in sentences({"methods": {"vanilla": method()}}, "m.json"))
