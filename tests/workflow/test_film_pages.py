"""The pages of films: what they show for the targets of a run, and that they ask for nothing."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from helpers import REPOSITORY

from drivesplat.errors import ConfigError
from drivesplat.io.yaml_file import read_yaml
from drivesplat.settings.edit import Edit
from drivesplat.settings.method import merged
from drivesplat.settings.report import FilmPageJob
from drivesplat.workflow.film_pages import FilmPages
from drivesplat.workflow.named_tracks import track_references
from drivesplat.workflow.plan import Plan

EDITS = """\
edits:
  gone:
    - remove: {track: a}
    - stop: {track: b, at: 3, duration: 2.5}
"""
TRAJECTORIES = {"aside": {"lateral": -2.0}, "plain": {}, "objects": {"parts": "moving"}}


def plan(tmp_path: Path, **render: Any) -> Plan:
    """Of scenes a1, which has an edit, and a2; results are in `tmp_path`/out."""
    (tmp_path / "edits.yaml").write_text(EDITS)
    dataset = {"scenes": ["a1", "a2"], "edits": {"a1": str(tmp_path / "edits.yaml")}}
    values = {
        "datasets": {"a": dataset}, "results_dir": str(tmp_path / "out"),
        "render": {"trajectories": TRAJECTORIES, **render},
        "methods": {"vanilla": {}, "street": {"parts": ["background", "actors"]}},
    }  # fmt: skip
    return Plan(values, str(REPOSITORY))


@pytest.fixture
def pages(tmp_path) -> FilmPages:
    """Of that plan, whose `targets` tests set."""
    return plan(tmp_path).film_pages()


def shown(pages: FilmPages, *targets: str, scene: str = "a1") -> dict[str, str]:
    """What the page shows in a run for these targets: words by paths."""
    pages._plan.targets = list(targets)
    job: FilmPageJob = pages.job(scene)
    kinds = ((*section.films, *section.pictures, *section.links) for section in job.sections)
    return {file.path: file.words for files in kinds for file in files}


def made(pages: FilmPages, *names: str) -> None:
    for name in names:
        path = Path(pages._results, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def test_the_page_of_everything_names_all_films_of_the_plan_and_what_each_shows(pages):
    found = shown(pages)
    plan: Any = pages._plan
    wanted = [*plan.films(scenes=["a1"]), *plan.edits(scenes=["a1"])]
    assert {path for path in found if path.endswith(".mp4")} == {
        path.removeprefix(f"{pages._results}/a1/") for path in wanted
    }
    assert found["compare.mp4"].startswith("recorded images, the renderings of vanilla, street with PSNR")
    assert (found["street/aside.mp4"], found["street/plain.mp4"]) == ("2 m to the right", "recorded drive, rendered")
    assert found["street/objects.mp4"] == "moving objects alone" and "vanilla/objects.mp4" not in found
    assert found["street/edits/gone.mp4"] == "edit gone: remove a; stop b, at 3, duration 2.5"
    others = {"metrics.json", "../gap_report.html", "street/viewer.html", "street/ghost_panel.png", "tracks.png"}
    assert others < found.keys() and not [path for path in found if "quad" in path or "truth" in path]
    films = [path for path in found if path.startswith("street/") and path.endswith(".mp4")]
    assert films[0] == "street/plain.mp4", "the recorded path first"


def test_the_page_beside_films_names_these_and_whatever_else_exists(pages):
    films = {path for path in shown(pages, "films") if path.endswith(".mp4")}
    assert films == set(shown(pages, "films")) and "street/edits/gone.mp4" not in films
    made(pages, "a1/street/quad/gone.mp4", "a1/metrics.json", "a1/street/old.mp4", "gap_report.html")
    found = shown(pages, "films")
    assert found.keys() - films == {"street/quad/gone.mp4", "metrics.json", "../gap_report.html"}
    assert "the edit gone" in found["street/quad/gone.mp4"]
    assert "street/quad/gone.mp4" not in shown(pages, "films", scene="a2")


def test_a_run_for_films_after_one_for_everything_changes_no_page(pages):
    plan: Any = pages._plan
    found = shown(pages)
    everything = pages.settings(SimpleNamespace(scene="a1"))
    made(pages, *(f"a1/{path}" for path in found))
    for targets in ([], ["all"], ["films"], ["edits"], [f"{pages._results}/a1/index.html"], None):
        plan.targets = targets
        assert pages.settings(SimpleNamespace(scene="a1")) == everything


def test_a_page_alone_shows_what_exists_and_what_is_made_beside_it_and_is_refused_without_any_film(pages):
    page, film = (f"{pages._results}/a1/{name}" for name in ("index.html", "vanilla/plain.mp4"))
    pages._plan.targets = [page]
    with pytest.raises(ConfigError, match=r"scene a1 has no film yet, .* the target films makes those of all scenes"):
        pages.refuse_empty([page])
    assert shown(pages, page, film).keys() == {"vanilla/plain.mp4"}
    pages.refuse_empty([page, film])
    made(pages, "a1/vanilla/aside.mp4")
    assert shown(pages, page).keys() == {"vanilla/aside.mp4"}
    pages.refuse_empty([page])


def test_an_edit_has_its_still_as_poster(pages):
    pages._plan.targets = []
    films = [film for section in pages.job("a1").sections for film in section.films]
    posters = {film.path: film.poster for film in films if film.poster}
    assert posters == {"street/edits/gone.mp4": "street/edits/gone.png"}


@pytest.mark.parametrize(
    ("step", "words"),
    [
        ({"remove": {"track": "6e5c"}}, "remove 6e5c"),
        ({"swap": {"track": "6e5c", "with": "7"}}, "swap 6e5c, with 7"),
        ({"ego": {"lateral": 3.5, "start": 1}}, "ego, start 1, lateral 3.5"),
        ({"place": {"track": "a", "as": "b", "path": [[0, 9.5, 0]]}}, "place a, as b, path [0 9.5 0]"),
        ({"recolour": {"track": "a", "from": "gold", "colour": "#0a2040"}}, "recolour a, colour #0a2040, from #ffd700"),
    ],
)
def test_a_step_of_an_edit_is_a_line_of_words(step, words):
    assert Edit.model_validate({"steps": [step]}).steps[0].in_words == words


# ---- films of four panels


def test_films_of_four_panels_come_with_films_where_the_settings_name_their_edits(tmp_path):
    chosen = plan(tmp_path, quad=["gone"])
    film = f"{tmp_path}/out/a1/street/quad/gone.mp4"
    assert film in chosen.films() and [path for path in chosen.films() if "quad" in path] == [film]
    assert film not in plan(tmp_path).films()
    assert "street/quad/gone.mp4" in shown(chosen.film_pages(), "films")
    named = track_references(chosen.config, "a1", ["films"]).edits
    assert {reference.track for reference in named} == {"a", "b"}, "checked before a run deletes anything"
    assert not track_references(plan(tmp_path).config, "a1", ["films"]).edits


def test_an_unknown_edit_of_four_panels_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"^render\.quad: scene a1 has no edit called 'halt'; there are: gone"):
        plan(tmp_path, quad=["halt"]).films()


def test_the_demo_makes_the_methods_side_by_side_and_one_edit_in_four_panels():
    preset = read_yaml(REPOSITORY / "presets/demo.yaml", "preset")
    files = Plan(merged(read_yaml(REPOSITORY / "config.yaml", "config file"), preset), str(REPOSITORY)).films()
    assert "results/demo/compare.mp4" in files
    assert [path for path in files if "/quad/" in path] == ["results/demo/street/quad/two_oncoming.mp4"]
