"""The names of edits and films of a scene, and the messages about unknown ones."""

from collections.abc import Iterable

from drivesplat.errors import ConfigError
from drivesplat.io.this_copy import of_the_workflow
from drivesplat.settings.blocks import block_scene_name
from drivesplat.settings.config import Config
from drivesplat.settings.edit import Edit
from drivesplat.workflow.edits_file import read_edits

EDITS, TRAJECTORIES = "edits", "trajectories"
EDIT_TRUTH = "edit_truth"
"""The folder of comparisons of edits with the truth of a synthetic world."""
"""Kinds of folders of drives and of scans, and the folders of a method in which they lie."""
QUAD = "quad"
"""The folder of a method with its films of four panels."""

FILM_PAGE = "index.html"
"""The page of a scene's films, in its folder."""


def scene_edits(config: Config, scene: str) -> dict[str, Edit]:
    """The edits of a scene by name; empty without an edits file. Raises ConfigError if the file is invalid, or inserts
    an asset into a drive that is cut into blocks."""
    path = config.datasets[config.dataset_of(scene)].edits.get(scene)
    edits = read_edits(of_the_workflow(path)) if path else {}
    for name, edit in edits.items() if config.is_cut(scene) else ():
        if any(step.insert for step in edit.steps):
            raise ConfigError(
                f"{path}: edit {name!r} inserts an asset, and scene {scene} is cut into blocks: insert it into one of "
                f"these, by an edits file of {block_scene_name(scene, 0)}"
            )
    return edits


def no_such_edit(scene: str, name: str, edits: Iterable[str]) -> str:
    """The message about an unknown edit of a scene."""
    known = ", ".join(edits) or "none"
    return f"scene {scene} has no edit called {name!r}; there are: {known} (datasets.<name>.edits names its edits file)"


def no_such_film(config: Config, whose: str, name: str) -> str:
    """The message about an unknown film of a scene or dataset; `config` as it holds there."""
    known = ", ".join(config.render.trajectories)
    return f"{whose} has no film called {name!r}; there are: {known} (add it to render.trajectories)"
