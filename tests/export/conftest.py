"""The drive that is exported, and a browser that shows a page of viewer.html."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from helpers.chromium import Tab, chromium
from helpers.hand_made_traffic import with_turning_track
from helpers.viewer_pages import HEIGHT, SHOWN_WITHOUT_WORDS, WIDTH


@pytest.fixture(scope="module")
def scene(tiny_scene):
    return with_turning_track(tiny_scene)


@pytest.fixture
def opened(tmp_path):
    """Opens a page from disk in a browser; it must not complain."""

    @contextmanager
    def open_page(page: str, name: str = "viewer") -> Iterator[Tab]:
        file = tmp_path / f"{name}.html"
        file.write_text(page, encoding="utf-8")
        with chromium(tmp_path / f"profile of {name}") as tab:
            tab.open(file, WIDTH, HEIGHT)
            tab.run(SHOWN_WITHOUT_WORDS)
            yield tab
            assert tab.complaints == []

    return open_page
