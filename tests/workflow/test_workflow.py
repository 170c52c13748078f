"""The whole DAG on a tiny world, as users run it."""

import json
import math
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import yaml
from helpers.archives import NO_FILES, addresses, addresses_in_results, dead_links
from helpers.chromium import chromium, in_a_browser
from helpers.killed_runs import only_complaint
from helpers.shared_runs import CAR, EDITS
from helpers.workflow_copy import WorkflowCopy, complaints
from PIL import Image

from drivesplat.evaluation.published_fixes import PUBLISHED_FIXES
from drivesplat.io.video import read_footage
from drivesplat.settings.report import HELD_OUT_PAIR

pytestmark = [pytest.mark.workflow, pytest.mark.xdist_group("workflow")]

REGIONS = ("all", "static", "vehicle", "car", "moving_vehicle", "parked_vehicle", "moving_human")


@pytest.fixture(scope="module")
def finished(finished_run, tmp_path_factory) -> WorkflowCopy:
    """A copy of the finished run; what a test changes in it, it changes back."""
    return finished_run.again(tmp_path_factory.mktemp("finished") / "workflow")


@contextmanager
def changed(copy: WorkflowCopy, *changes: tuple[str, str, str]) -> Iterator[None]:
    """Files of the workflow changed for a while: `(file, old, new)`."""
    before = {copy.folder / file: (copy.folder / file).read_text() for file, _, _ in changes}
    for file, old, new in changes:
        assert old in before[copy.folder / file]
        (copy.folder / file).write_text(before[copy.folder / file].replace(old, new, 1))
    try:
        yield
    finally:
        for path, content in before.items():
            path.write_text(content)


def test_metrics_json_is_what_the_measuring_protocol_promises(finished):
    metrics = finished.read("results/0001/metrics.json")
    assert (metrics["schema"], metrics["scene"], metrics["dataset"]) == (1, "0001", "nuscenes")
    expected = {
        "version": "v1.0-mini", "cameras": ["CAM_FRONT"], "eval_camera": "CAM_FRONT", "width": 96, "height": 54,
        "sweeps": False, "holdout": {"every_nth": 8, "offset": 4, "last_block": 4}, "train_images": 5,
        "held_out_frames": {"interpolation": [4], "extrapolation": [6, 7, 8, 9]}, "poses": "nuscenes",
        "regions": "boxes", "visibility": "annotated", "extra_points": None, "lidar_missing": 0,
    }  # fmt: skip
    assert {key: metrics["protocol"][key] for key in expected} == expected
    assert {"settings_sha256", "code_sha256", "inputs_sha256", "versions"} <= metrics["provenance"].keys()
    assert set(metrics["methods"]) == {"vanilla", "street"}
    for result in metrics["methods"].values():
        for group in ("interpolation", "extrapolation"):
            assert set(REGIONS) | {"gap_db", "human_gap_db", "depth"} == set(result[group])
            assert result[group]["all"]["psnr"] > 8.0
            for record in filter(None, (result[group][region] for region in REGIONS)):
                assert record["pixels"] >= 1000 and math.isfinite(record["psnr"]) and record["ssim"] <= 1.0
        whole, moving = result["extrapolation"]["static"], result["extrapolation"]["moving_vehicle"]
        assert result["extrapolation"]["gap_db"] == pytest.approx(whole["psnr"] - moving["psnr"])
        assert (result["train_iterations"], result["peak_gpu_memory_gb"]) == (20, None)
        assert result["lpips_unavailable"] == "lpips.enabled is false"
    report = finished.read("results/gap_report.json")
    assert [(row["scene"], row["method"]) for row in report["rows"]] == [("0001", "vanilla"), ("0001", "street")]
    assert report["left_out"] == [] and report["missing"] == []
    lines = (finished.folder / "results/gap_report.csv").read_text().splitlines()
    assert len(lines) == 3 and lines[0].startswith("scene,dataset,method")


def test_what_a_training_leaves_behind(finished):
    folder = finished.folder / "results/0001/vanilla"
    trained = {"checkpoint.npz", "train.json", "eval.json", "eval_objects.json", "tensorboard", ".digests"} | set(
        HELD_OUT_PAIR.values()
    )
    films = {f"{film}.{kind}" for film in ("original", "lateral_2m") for kind in ("mp4", "cameras.json")}
    looks = {"ghost_panel.png", "ghost_panel.json", "with_car.png", "without_car.png", "removal.png", "removal.json"}
    exports = {"cameras.json", "transforms.json", "parts", "scene.usdz", "viewer.html", "colmap", "far.npz"}
    exports |= {"splat.ply"}
    of_both = trained | films | looks | exports
    assert of_both == {path.name for path in folder.iterdir()}
    assert list((folder / "tensorboard").glob("events.*"))
    street = finished.folder / "results/0001/street"
    assert of_both | {"parts.mp4", "parts.cameras.json", "edits"} == {path.name for path in street.iterdir()}
    edits = {f"{edit}.{kind}" for edit in ("gone", "stop") for kind in ("mp4", "png", "json")}
    assert edits | {".digests"} == {path.name for path in (street / "edits").iterdir()}


def test_a_film_lasts_as_long_as_the_drive_and_runs_beside_it(finished):
    drive = finished.read("results/0001/scene.json")
    times = [frame["timestamp"] for frame in drive["frames"]]
    recorded, beside = (
        finished.read(f"results/0001/vanilla/{film}.cameras.json") for film in ("original", "lateral_2m")
    )
    assert abs(recorded["duration_s"] - (max(times) - min(times)) * 1e-6) <= 1 / recorded["fps"]
    assert (recorded["width"], recorded["height"], recorded["fps"]) == (64, 36, 4)
    centers = [np.array(film["camera_to_world"])[:, :3, 3] for film in (recorded, beside)]
    left = np.array(drive["frames"][0]["ego_to_world"])[:3, 1]  # the tiny drive goes straight on
    np.testing.assert_allclose(centers[1] - centers[0], np.tile(2.0 * left, (recorded["frames"], 1)), atol=1e-6)


@pytest.mark.parametrize(("method", "by"), [("vanilla", "box"), ("street", "actor")])
def test_the_vehicle_looked_at_is_the_one_removed(finished, method, by):
    panel, removal = (finished.read(f"results/0001/{method}/{name}.json") for name in ("ghost_panel", "removal"))
    assert panel["subject"] == removal["subject"] and panel["subject"]["category"] == "vehicle.car"
    assert removal["removed_by"] == by
    kept = removal["outside_footprint"]
    assert kept.get("identical") or kept["psnr"] >= 90.0


def test_an_edit_becomes_a_film_a_still_and_labels(finished):
    """The car stands a metre beside its way in the end: braking takes two seconds, in which it comes as far as in one
    at its 4.2 m/s."""
    folder = finished.folder / "results/0001/street/edits"
    labels, drive = finished.read("results/0001/street/edits/stop.json"), finished.read("results/0001/scene.json")
    (car,) = (track for track in labels["tracks"] if track["editable"])
    assert (car["id"], car["edited"], labels["frames"]) == (CAR, True, 19)
    recorded = next(track for track in drive["tracks"] if track["id"] == CAR)["object_to_world"]
    place = [pose[3] for pose in car["object_to_world"][-1][:2]]
    np.testing.assert_allclose(place, [recorded[0][0][3] + 4.2 * (3.0 - 0.035), 1.0], atol=0.3)
    footage = read_footage(folder / "stop.mp4")
    assert (footage.frames, footage.width, footage.height) == (19, 128, 36)
    assert Image.open(folder / "stop.png").size == (128, 36)
    assert [step.keys() for step in labels["edit"]["steps"]] == [{"shift"}, {"stop"}]
    gone = finished.read("results/0001/street/edits/gone.json")
    assert not any(track["editable"] for track in gone["tracks"])
    assert gone["camera_to_world"] == labels["camera_to_world"]


def test_all_methods_are_in_one_film_beside_the_recording(finished):
    record = finished.read("results/0001/compare.json")
    assert [panel["shows"] for panel in record["film"]["panels"]] == [
        "ground truth", "vanilla", "street", "error of street"
    ]  # fmt: skip
    footage = read_footage(finished.folder / "results/0001/compare.mp4")
    assert (footage.frames, footage.width, footage.height, footage.fps) == (10, 2 * 96, 2 * 54, 2.0)
    assert {"vanilla/train", "street/train"} < record["provenance"]["stages"].keys()


def test_every_result_remembers_where_it_came_from(finished):
    for name in ("original.cameras.json", "ghost_panel.json", "removal.json", "cameras.json", "eval.json"):
        stages = finished.read(f"results/0001/vanilla/{name}")["provenance"]["stages"]
        assert {"extract", "vanilla/train"} < stages.keys(), name
    for name in ("parts.cameras.json", "edits/stop.json"):
        stages = finished.read(f"results/0001/street/{name}")["provenance"]["stages"]
        assert {"extract", "actors", "lidar_depth", "street/train"} < stages.keys(), name


@pytest.fixture(scope="module")
def archive(finished, tmp_path_factory) -> Path:
    """Snakemake's report of that run, unpacked elsewhere."""
    done = finished.run(flags=("--report", "report.zip"))
    assert done.returncode == 0, done.stdout
    folder = tmp_path_factory.mktemp("archive")
    with zipfile.ZipFile(finished.folder / "report.zip") as report:
        report.extractall(folder)
    return folder / "report"


def test_snakemakes_report_holds_all_there_is_to_look_at_and_what_its_pages_link_to(archive):
    names = [path.name for path in archive.rglob("*") if path.is_file()]
    page = (archive / "report.html").read_text(encoding="utf-8")
    films = {"original.mp4", "lateral_2m.mp4", "parts.mp4", "stop.mp4", "gone.mp4"}
    pictures = {"ghost_panel.png", "removal.png", "stop.png", "gone.png", "tracks.png"}
    assert films | pictures | {"metrics.json", "gap_report.csv", "ghosts.html"} < set(names)
    assert names.count("viewer.html") == 2 and names.count("gap_report.html") == 1
    assert "Scene 0001" in page and "Across scenes" in page and "the moving vehicle that fills most pixels" in page
    assert "the moving parts on grey" in page and "the frame with the largest difference" in page
    assert all(page.count(fix.method) >= 2 for fix in PUBLISHED_FIXES), "captions of ghost panels name published fixes"
    dead, links = dead_links(archive)
    assert dead == set() and links > 30
    (report,) = archive.rglob("gap_report.html")
    linked = {Path(address).name for address in addresses(report.read_text(encoding="utf-8"))}
    assert films | {"compare.mp4", "viewer.html"} < linked
    captions = addresses_in_results(page)
    assert sum(address.endswith("/ghosts.html") for address in captions) == 1 + 2, "itself, and two ghost panels"


@pytest.mark.parametrize("name", ["gap_report.html", "0001/index.html"])
def test_every_link_of_a_page_in_the_results_folder_is_in_it(finished, name):
    page = finished.folder / "results" / name
    links = [at for at in addresses(page.read_text(encoding="utf-8")) if not at.startswith(NO_FILES)]
    assert len(links) > 10 and all((page.parent / at.partition("#")[0]).is_file() for at in links)


@in_a_browser
def test_in_a_browser_snakemakes_report_requests_nothing_but_its_files(archive, tmp_path):
    """Every page, and every result in Snakemake's page as a click on it shows it."""
    with chromium(tmp_path / "profile") as tab:
        pages = sorted(archive.rglob("*.html"))
        for page in pages:
            tab.open(page, 1000, 700)
            tab.picture()
        tab.open(archive / "report.html", 1000, 700)
        shown = tab.run(
            "Object.entries(results).map(([path, result]) => {"
            " const kind = {'text/html': 'html', 'image/png': 'img'}[result.mime_type];"
            " if (kind) app.setView({content: kind, contentPath: result.data_uri, resultPath: path});"
            " return kind })"
        )
        tab.picture()
        assert shown.count("html") == 4 and shown.count("img") >= 5
    outside = [address for address in tab.requests if not address.startswith(("data:", "blob:"))]
    assert {*map(Path.as_uri, pages)} <= set(outside)
    assert [address for address in outside if not address.startswith(archive.as_uri())] == []


SLOW = pytest.mark.slow
"""For settings that `settings/test_config.py` follows to their stages, too."""
OF_ACTORS = {"film_parts": 1, "edit": 2}
"""What a method with actors has and others have not."""
EXPORTS = ("far_gaussians", "export", "export_usd", "export_viewer")
COLMAP = {"export_colmap": 2}
TRAINING_AND_AFTER = {
    "train": 2, "evaluate": 2, "scene_metrics": 1, "gap_report": 1, "ghost_panel": 2,
    "remove_actor": 2, "compare": 1, "film": 4, **OF_ACTORS, **dict.fromkeys(EXPORTS, 2),
}  # fmt: skip
ONE_TRAINING_AND_AFTER = {
    "train": 1, "evaluate": 1, "scene_metrics": 1, "gap_report": 1, "compare": 1, "film": 2, "ghost_panel": 1,
    "remove_actor": 1, **dict.fromkeys(EXPORTS, 1),
}  # fmt: skip
STREETS_TRAINING_AND_AFTER = ONE_TRAINING_AND_AFTER | OF_ACTORS
TRAINING_INPUTS = {"actors": 1, "lidar_depth": 1}
AFTER_EXTRACTION = {
    "lidar_seed": 1, "parser": 1, "masks": 1, "tracks": 1, **TRAINING_INPUTS, **TRAINING_AND_AFTER, **COLMAP
}  # fmt: skip
EVERYTHING = {"extract": 1, "own_car": 1, **AFTER_EXTRACTION}
NO_STAGE = {"refine_poses": {"rounds": 2, "enabled": False}, "device": {"kind": "cpu", "min_free_gb": 1},
            "lpips": {"enabled": False, "timeout_s": 3}}  # fmt: skip
"""Settings of a stage that is left out, and of machines alone."""


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        pytest.param({"train": {"iterations": 61}}, TRAINING_AND_AFTER, marks=SLOW),
        pytest.param({"actors": {"humans": True}}, {"actors": 1, "tracks": 1, **STREETS_TRAINING_AND_AFTER},
                     marks=SLOW),
        ({"refine_poses": {"enabled": True}}, {"refine_poses": 1, **AFTER_EXTRACTION}),
        pytest.param({"render": {"end": "trained"}}, {"film": 4, "compare": 1, **OF_ACTORS}, marks=SLOW),
        pytest.param({"export": {"sh_degree": 3, "formats": ["ply", "spz"]}}, {"export": 2, "export_spz": 2},
                     marks=SLOW),
        ({"methods": {"third": {}}},
         {**ONE_TRAINING_AND_AFTER, "export_viewer": 3, "export_colmap": 1, "film_page": 1}),
    ],
)  # fmt: skip
def test_a_changed_setting_reruns_its_stage_and_what_depends_on_it(finished, setting, expected):
    """What reaches no stage reruns nothing."""
    changed = {**finished.config, **NO_STAGE}
    for key, value in setting.items():
        changed[key] = {**changed[key], **value} if isinstance(changed.get(key), dict) else value
    with finished.set_to(**changed):
        assert finished.planned() == {rule: n for rule, n in expected.items() if n}


def test_the_reason_of_a_rerun_is_the_changed_setting(finished):
    with finished.set_to(train={**finished.config["train"], "iterations": 61}):
        printed = finished.dry_run("metrics")
    trained = [line.strip() for line in printed.splitlines() if "iterations" in line]
    assert sorted(trained) == [f"reason: train {method}: train.iterations 20 -> 61" for method in ("street", "vanilla")]
    assert max(map(len, printed.splitlines())) < 2000


def test_the_page_has_the_edits_of_a_method_with_actors_the_images_and_the_other_method(finished):
    for method, edits in (("street", ["gone", "stop"]), ("vanilla", [])):
        page = (finished.folder / f"results/0001/{method}/viewer.html").read_text(encoding="utf-8")
        scene = json.loads(page.partition('id="scene">')[2].partition("</script>")[0])
        assert [edit["name"] for edit in scene["edits"]] == edits
        assert [image["second"] for image in scene["images"]] == scene["key_frames"]
        assert scene["method"] == method and scene["methods"] == ["street", "vanilla"]


PLAYED = {"export_viewer": 1, "film_page": 1}
"""The page of the method that can be edited plays the edits, and the page of films lists their steps. The report, which
links to the films and to both pages, follows one run later if an edit is gone: Snakemake does not look at jobs behind
others that run."""
LEFT_GONE = "results/0001/street/edits/gone.mp4"


@pytest.mark.parametrize(
    ("old", "new", "expected", "of_gone"),
    [
        ("at: 2}", "at: 2.5}", {"edit": 1, **PLAYED}, {}),
        ("  stop:", "  also_gone:\n    - remove: {track: 0001 instance 0}\n  stop:",
         {"edit": 1, **PLAYED, "gap_report": 1}, None),
        (EDITS, """# written otherwise
edits: {stop: [{shift: {lateral: 1, "track": "0001 instance 0", yaw: 0.0, start: null}},
               {stop: {duration: 2, at: 2.0, track: 0001 instance 0}}],
        gone: [{remove: {track: '0001 instance 0'}}]}
""", {}, None),
    ],
    ids=["a step", "one more edit", "written otherwise"],
)  # fmt: skip
def test_a_changed_step_reruns_its_edit_and_the_page_that_plays_it(finished, old, new, expected, of_gone):
    assert old in EDITS
    with changed(finished, ("edits.yaml", old, new)):
        assert finished.planned() == expected
        if of_gone is not None:
            assert finished.planned(LEFT_GONE) == of_gone


def test_a_changed_step_hides_no_change_of_the_report(finished):
    """The page links to the film, which is no reason to leave the page as it was."""
    with changed(
        finished, ("edits.yaml", "at: 2}", "at: 2.5}"), ("drivesplat/report/gaps.py", "SCHEMA = 3", "SCHEMA = 4")
    ):
        assert finished.planned() == {"edit": 1, **PLAYED, "gap_report": 1}


def test_an_edit_of_a_track_that_there_is_none_of_fails_in_one_line(finished):
    typo = "  typo:\n    - remove: {track: abcd}\n  gone:"
    with changed(finished, ("edits.yaml", "  gone:", typo)):
        target = "results/0001/street/edits/typo.mp4"
        done, planned = (finished.run(target, flags=flags) for flags in ((), ("-n",)))
    line = only_complaint(done)
    assert planned.returncode != 0 and complaints(planned.stdout) == {line}
    words = ("scene 0001, edit 'typo', step 1 (remove)", "'abcd'", f"tracks that move: {CAR[:8]}")
    assert all(word in line for word in words), line
    assert not list((finished.folder / "results/0001/street/edits").glob("*typo*"))


def test_a_wrong_track_is_refused_before_a_result_is_deleted(finished):
    pictures = [finished.folder / f"results/0001/vanilla/{name}" for name in ("removal.png", "ghost_panel.png")]
    had = [path.read_bytes() for path in pictures]
    with finished.set_to(subjects={"0001": {"track": "0001 instance 9"}}):
        line = only_complaint(finished.run(*(str(path.relative_to(finished.folder)) for path in pictures)))
    words = ("subjects.0001", "no track '0001 instance 9'", "did you mean 0001 instance", f"tracks that move: {CAR}")
    assert all(word in line for word in words), line
    assert [path.read_bytes() for path in pictures] == had


def test_order_comments_written_out_defaults_touched_files_and_a_fresh_checkout_rerun_nothing(finished):
    """Of settings, and of the code; `refine_poses` is not enabled."""
    for path in finished.folder.rglob("*"):
        if (
            path.is_file()
            and ".snakemake" not in path.parts
            and path.suffix in (".py", ".smk", ".yaml", ".json", ".ply")
        ):
            content = path.read_bytes()
            path.unlink()
            path.write_bytes(content)
    reversed_keys = {key: finished.config[key] for key in reversed(finished.config)}
    reversed_keys["lidar_seed"] = {"voxel_size": 0.1, "far_points": 100, "max_points": 500}
    finished.write_config("# a comment\n" + yaml.safe_dump(reversed_keys, sort_keys=False))
    try:
        with changed(finished, *COMMENTS, UNUSED):
            assert finished.planned() == {}
    finally:
        finished.write_config()


def test_changed_tables_rerun_the_scenes_whose_rows_they_change(finished):
    def planned_with(table: str, change: Callable[[list[dict]], None]) -> dict[str, int]:
        path = finished.folder / f"data/v1.0-mini/{table}.json"
        before = path.read_bytes()
        rows = json.loads(before)
        change(rows)
        path.write_text(json.dumps(rows))
        try:
            return finished.planned()
        finally:
            path.write_bytes(before)

    assert planned_with("sample", lambda rows: rows.append({**rows[0], "token": "x", "scene_token": "other"})) == {}
    assert planned_with("sample_annotation", lambda rows: rows[3].update(size=[1.0, 2.0, 3.0])) == EVERYTHING


COMMENTS = (
    ("drivesplat/evaluation/metrics.py", '"""Peak signal', '"""The peak signal'),
    ("drivesplat/preprocess/masks.py", "BRIGHT = 0.7", "BRIGHT = 0.7  # overcast"),
    ("drivesplat/settings/train.py", "Number of optimisation", "The number of optimisation"),
    ("workflow_scripts/parser.py", '"""scene.json', '"""The scene.json'),
)
UNUSED = ("drivesplat/preprocess/poses/refinement_record.py", "SCHEMA = 1", "SCHEMA = 2")


@pytest.mark.parametrize(
    ("file", "old", "new", "expected"),
    [
        ("drivesplat/preprocess/masks.py", "BRIGHT = 0.7", "BRIGHT = 0.71",
         {"masks": 1, "tracks": 1, **TRAINING_AND_AFTER}),
        pytest.param("drivesplat/scene/object_class.py", "MOVING_VEHICLE = 1.0", "MOVING_VEHICLE = 2.0",
                     {**EVERYTHING, "film_page": 1}, marks=SLOW),
    ],
)  # fmt: skip
def test_changed_code_reruns_exactly_the_stages_that_import_it(finished, file, old, new, expected):
    with changed(finished, (file, old, new)):
        assert finished.planned() == {rule: count for rule, count in expected.items() if count}


def test_a_truncated_result_is_named_with_the_rule_that_rebuilds_it(finished, tmp_path):
    copy = finished.again(tmp_path / "copy")
    seed = copy.folder / "results/0001/seed.ply"
    seed.write_bytes(seed.read_bytes()[:2000])
    line = only_complaint(copy.run("results/0001/metrics.json"))
    assert "seed.ply" in line and "lidar_seed" in line
    assert not (copy.folder / "results/0001/parser.pkl").exists()


def test_a_drive_in_four_panels_is_made_on_request(finished):
    """The last test of this file, since it adds a folder to the results."""
    done = finished.run("results/0001/street/quad/stop.mp4")
    assert done.returncode == 0, done.stdout
    footage = read_footage(finished.folder / "results/0001/street/quad/stop.mp4")
    assert (footage.frames, footage.width, footage.height) == (19, 128, 72)
    labels = finished.read("results/0001/street/quad/stop.json")
    assert {"extract", "street/train"} < labels["provenance"]["stages"].keys() and len(labels["film"]["panels"]) == 4
