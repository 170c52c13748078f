"""Opens the exported page of a scene, viewer.html, in a browser."""

import webbrowser
from pathlib import Path

from drivesplat.errors import DriveSplatError
from drivesplat.io.this_copy import default_config
from drivesplat.io.yaml_file import read_yaml
from drivesplat.settings.config import load

PAGE, OF_MOVING_OBJECTS = "viewer.html", "parts.mp4"


def results_folder() -> Path:
    """The results folder of the current folder's config.yaml, by default `results`. Raises ConfigError."""
    return Path(load(read_yaml(default_config(Path.cwd()), "config file") or {}).results_dir)


def open_viewer(results: Path, scene: str | None, method: str | None) -> str:
    """Opens the page of a scene and method in the browser; returns what was opened, and which others there are.

    Raises DriveSplatError where there is no such page, or no browser.
    """
    pages = exported_pages(results)
    page = chosen_page(pages, results, scene, method)
    if not webbrowser.open_new_tab(page.resolve().as_uri()):
        raise DriveSplatError(f"no browser was found; open {page.resolve()} in one, also on another machine")
    others = [f"{at[0]} {at[1]}" for at, other in sorted(pages.items()) if other != page]
    return f"opened {page}" + (f"; there are also: {', '.join(others)}" if others else "")


def exported_pages(results: Path) -> dict[tuple[str, str], Path]:
    """The exported pages below a results folder, by scene and method."""
    found = sorted(results.glob(f"*/*/{PAGE}"))
    return {(page.parent.parent.name, page.parent.name): page for page in found}


def chosen_page(
    pages: dict[tuple[str, str], Path], results: Path, scene: str | None = None, method: str | None = None
) -> Path:
    """The page of a scene and method: by default of the scene exported last, and there of a method with moving objects.
    Raises DriveSplatError where there is none."""
    matching = {at: page for at, page in pages.items() if scene in (None, at[0]) and method in (None, at[1])}
    if not matching:
        wanted = f"{results / (scene or '{scene}') / (method or '{method}') / PAGE}"
        known = ", ".join(f"{at[0]} {at[1]}" for at in sorted(pages)) or "none"
        raise DriveSplatError(
            f"there is no {wanted}; exported are: {known}. The workflow exports a scene with "
            f"`drivesplat run --cores 1 -- {wanted}`; with --results the pages of another folder are opened"
        )
    newest = max(matching, key=lambda at: matching[at].stat().st_mtime)[0]
    of_scene = [page for at, page in matching.items() if at[0] == newest]
    return max(of_scene, key=lambda page: (page.with_name(OF_MOVING_OBJECTS).is_file(), page.stat().st_mtime))
