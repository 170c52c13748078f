"""The figures and pages that a finished run names."""

import json
from pathlib import Path

from drivesplat.report.run_figures import MAX_SCENES, print_run_figures

GROUP = {"static": {"psnr": 27.1}, "moving_vehicle": {"psnr": 16.0}, "gap_db": 11.1}


def scene(results: Path, name: str) -> list[str]:
    folder = results / name
    folder.mkdir(parents=True)
    methods = {"street": {"interpolation": GROUP, "extrapolation": {}}}
    (folder / "metrics.json").write_text(json.dumps({"scene": name, "methods": methods}))
    return [f"{folder}/metrics.json", f"{folder}/index.html"]


def test_scenes_of_the_run_have_a_row_and_existing_pages_are_named(tmp_path, capsys):
    outputs = [*scene(tmp_path, "one"), *scene(tmp_path, "two"), f"{tmp_path}/gap_report.html"]
    scene(tmp_path, "of another run")
    for page in ("one/index.html", "gap_report.html"):
        (tmp_path / page).touch()
    print_run_figures([*outputs, f"{tmp_path}/three/metrics.json"], tmp_path)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("drivesplat: PSNR of held-out images")
    assert [line.split() for line in lines if "street" in line] == [
        [name, "street", "27.1", "16.0", "11.1"] for name in ("one", "two")
    ]
    assert lines[-3:] == [
        f"  figures: {tmp_path}/one/metrics.json, {tmp_path}/two/metrics.json",
        f"  films: {tmp_path}/one/index.html",
        f"  report: {tmp_path}/gap_report.html",
    ]


def test_runs_without_figures_say_nothing_and_long_batches_are_cut(tmp_path, capsys):
    (tmp_path / "one").mkdir()
    (tmp_path / "one/index.html").touch()
    print_run_figures([f"{tmp_path}/one/street/checkpoint.npz"], tmp_path)
    assert capsys.readouterr().err == ""
    print_run_figures([f"{tmp_path}/one/index.html"], tmp_path)
    assert capsys.readouterr().err == f"drivesplat: results of this run\n  films: {tmp_path}/one/index.html\n"
    outputs = [file for number in range(MAX_SCENES + 3) for file in scene(tmp_path, f"scene{number:03d}")]
    print_run_figures(outputs, tmp_path)
    said = capsys.readouterr().err
    assert said.count(" street ") == MAX_SCENES and "… and 3 scenes more" in said


def test_a_damaged_file_is_named_and_ends_nothing(tmp_path, capsys):
    outputs = scene(tmp_path, "one")
    Path(outputs[0]).write_text("{")
    print_run_figures(outputs, tmp_path)
    assert f"cannot be shown: {outputs[0]}: not a readable JSON file" in capsys.readouterr().err
