"""index.html of a scene: the films that exist, in words, and links that need nothing but the folder of results."""

from pathlib import Path

import numpy as np
import pytest
from helpers.archives import NO_FILES, addresses
from helpers.chromium import chromium, in_a_browser
from PIL import Image

from drivesplat.io.video import write_video
from drivesplat.report.film_page import write_film_page
from drivesplat.settings.report import FilmPageJob, FilmSection, ShownFile

FILMS = ("street/original.mp4", "street/edits/a b.mp4", "street/never made.mp4")


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    """The page of a scene with two films, of which one has a poster, a picture, and a film that was not made."""
    folder = tmp_path_factory.mktemp("results") / "0061"
    for number, name in enumerate(FILMS[:2]):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        frames = np.full((4, 36, 64, 3), 60 + 60 * number, np.uint8)
        write_video(folder / name, iter(frames), (64, 36), 4, 18)
    for name in ("street/edits/a b.png", "street/ghost_panel.png"):
        Image.new("RGB", (64, 36), (200, 30, 30)).save(folder / name)
    (folder / "metrics.json").write_text("{}")
    films = [ShownFile(path=name, words=f"film <{number}>") for number, name in enumerate(FILMS)]
    films[1] = films[1].model_copy(update={"poster": "street/edits/a b.png"})
    sections = (
        FilmSection(title="All methods", links=(ShownFile(path="metrics.json", words="figures"),)),
        FilmSection(
            title="street",
            films=tuple(films),
            pictures=(ShownFile(path="street/ghost_panel.png", words="ghosts"),),
        ),
    )
    write_film_page(folder / "index.html", FilmPageJob(scene="0061", sections=sections))
    return folder / "index.html"


def test_the_page_links_to_its_files_by_paths_inside_the_folder_of_results(page):
    text = page.read_text(encoding="utf-8")
    found = {address.partition("#")[0] for address in addresses(text) if not address.startswith(NO_FILES)}
    known = {name.replace(" ", "%20") for name in FILMS}
    assert found == {*known, "metrics.json", "street/edits/a%20b.png", "street/ghost_panel.png"}
    assert "film &lt;0&gt;" in text and "http" not in text and "prefers-color-scheme: dark" in text


@in_a_browser
def test_in_a_browser_films_have_a_picture_and_what_is_absent_is_hidden(page, tmp_path):
    shown = "[...document.querySelectorAll('figure')].map((it) => getComputedStyle(it).display !== 'none')"
    sizes = "[...document.querySelectorAll('video')].map((it) => it.videoWidth)"
    loaded = (
        "new Promise((done) => setInterval(() => [...document.querySelectorAll('video')]"
        ".every((it) => it.error || it.readyState >= 2) && done(true), 50))"
    )
    with chromium(tmp_path / "profile") as tab:
        tab.open(page, 1300, 900)
        assert tab.run(loaded)
        assert tab.run(shown) == [True, True, False, True]
        assert tab.run(sizes) == [64, 64, 0]
        assert {address.rpartition("/")[0] for address in tab.requests if not address.startswith("data:")} <= {
            folder.as_uri() for folder in (page.parent, page.parent / "street", page.parent / "street/edits")
        }
