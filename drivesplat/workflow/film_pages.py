"""The pages of films: what the page of a scene shows, in words, and which of it exists."""

import os
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from drivesplat.errors import ConfigError
from drivesplat.io.storage import canonical_json
from drivesplat.settings.config import for_scene
from drivesplat.settings.render import PARTS_IN_WORDS, RECORDED_IN_WORDS
from drivesplat.settings.report import FilmPageJob, FilmSection, ShownFile
from drivesplat.workflow.film_names import EDITS, FILM_PAGE, QUAD, scene_edits
from drivesplat.workflow.outputs import COMPARE_FILM, LIDAR, PARTS_FILM, TRUTH_FILM, Outputs
from drivesplat.workflow.report_plan import EVERYTHING, REPORT_FILES
from drivesplat.workflow.runs_file import RUNS, runs_of
from drivesplat.workflow.without_cameras import has_cameras, scene_methods

REPORT_PAGE = REPORT_FILES[0]
LINKS_OF_SCENE = {"metrics.json": "figures of all methods", f"../{REPORT_PAGE}": "report across scenes"}
PICTURES_OF_SCENE = {"tracks.png": "moving objects, with the ids that edits name"}
LINKS_OF_METHOD = {"viewer.html": "viewer with a free camera"}
LINKS_OF_DRIVE = {"viewer.html": "map of the drive, with the viewers of its blocks"}
PICTURES_OF_METHOD = {
    "ghost_panel.png": "a moving vehicle: ground truth, rendering, error and ghosts",
    "removal.png": "the vehicle removed",
    "lidar.png": "held-out LiDAR scans, recorded and rendered",
}
"""Files beside films, and what they show. The target `all` makes them, so that a second run changes no page."""


class FilmPages:
    """The pages of films of a `plan`. A page names the films that the targets of the run make, and those that exist: it
    reads none of them, and asks for none."""

    def __init__(self, plan: Outputs, targets: Callable[[], list[str] | None]):
        """`targets` gives the targets of the run, None where they are not known."""
        self._plan, self._targets = plan, targets
        self._results = plan.config.results_dir

    def pages(self, _: Any = None) -> list[str]:
        """The pages of the batch's scenes."""
        return [f"{self._results}/{scene}/{FILM_PAGE}" for scene in self._plan.config.batch_scenes]

    def settings(self, wildcards: Any) -> str:
        """The settings of a page as canonical JSON."""
        return canonical_json(self.job(wildcards.scene).model_dump(mode="json"))

    def job(self, scene: str) -> FilmPageJob:
        """The settings of the page of a scene."""
        planned = self._planned(scene)
        folder = Path(self._results, scene)

        def shown(files: Iterable[ShownFile]) -> tuple[ShownFile, ...]:
            return tuple(file for file in files if file.path in planned or (folder / file.path).is_file())

        def named(files: dict[str, str], inside: str = "") -> tuple[ShownFile, ...]:
            return shown(ShownFile(path=f"{inside}{name}", words=words) for name, words in files.items())

        methods = scene_methods(self._plan.config, scene)
        compared = f"recorded images, the renderings of {', '.join(methods)} with PSNR, and the error of the last"
        sections = [
            FilmSection(
                title="All methods",
                films=named({COMPARE_FILM: compared}),
                pictures=named(PICTURES_OF_SCENE),
                links=named(LINKS_OF_SCENE),
            )
        ]
        for method in methods:
            films = shown(self._films(scene, method))
            own_links = LINKS_OF_DRIVE if self._plan.config.is_cut(scene) else LINKS_OF_METHOD
            pictures, links = (named(files, f"{method}/") for files in (PICTURES_OF_METHOD, own_links))
            sections.append(FilmSection(title=method, films=films, pictures=pictures, links=links))
        return FilmPageJob(scene=scene, sections=tuple(sections))

    def refuse_empty(self, targets: list[str]) -> None:
        """Raises ConfigError if a target is the page of a scene without any film."""
        pages = {os.path.normpath(f"{self._results}/{scene}/{FILM_PAGE}"): scene for scene in self._plan.config.scenes}
        for scene in (pages[path] for path in map(os.path.normpath, targets) if path in pages):
            if not any(section.films for section in self.job(scene).sections):
                raise ConfigError(
                    f"scene {scene} has no film yet, and {FILM_PAGE} asks for none: the target films makes those of "
                    f"all scenes, {self._results}/{scene}/<method>/original.mp4 makes one"
                )

    def _films(self, scene: str, method: str) -> list[ShownFile]:
        """The films that a method may have: along the recorded path, along other paths, of parts, of edits, and of runs
        in the closed loop."""
        of_scans = ShownFile(path=f"{method}/{LIDAR}.mp4", words="LiDAR scans: recorded, rendered, and the error")
        if not has_cameras(self._plan.config, scene):
            return [of_scans]
        trajectories = for_scene(self._plan.config, scene).render.trajectories
        words = {name: trajectory.in_words for name, trajectory in trajectories.items()}
        names = sorted(words, key=lambda name: (words[name] != RECORDED_IN_WORDS, name))
        words[PARTS_FILM] = ", ".join(PARTS_IN_WORDS.values())
        words[TRUTH_FILM] = "from beside the path: the true images, the renderings, and the error"
        found = [ShownFile(path=f"{method}/{name}.mp4", words=words[name]) for name in (*names, PARTS_FILM, TRUTH_FILM)]
        found.append(of_scans)
        for name, edit in sorted(scene_edits(self._plan.config, scene).items()):
            steps, file = "; ".join(step.in_words for step in edit.steps), f"{method}/{EDITS}/{name}"
            found.append(ShownFile(path=f"{file}.mp4", words=f"edit {name}: {steps}", poster=f"{file}.png"))
            four = f"recorded images, their reconstruction, the smooth drive, and the edit {name}"
            found.append(ShownFile(path=f"{method}/{QUAD}/{name}.mp4", words=four))
        for name, run in runs_of(self._plan.config, scene, method).items():
            where = "" if run.edit is None else f" after the edit {run.edit}"
            words = f"run {name}: {run.policy} drives{where}; the camera, and the street from above"
            found.append(ShownFile(path=f"{method}/{RUNS}/{name}.mp4", words=words))
        return found

    def _planned(self, scene: str) -> set[str]:
        """The files that the run makes, relative to the folder of a scene; its films where targets are not known."""
        plan, targets = self._plan, self._targets()
        asked = {"films"} if targets is None else set(targets)
        everything = not asked or EVERYTHING in asked
        made: dict[str, Callable[[], list[str]]] = {
            "films": lambda: plan.films(scenes=[scene]),
            "edits": lambda: plan.edits(scenes=[scene]),
            "runs": lambda: [path.replace(".json", ".mp4") for path in plan.runs(scenes=[scene])],
            "looks": plan.looks,
            "exports": plan.exports,
            "metrics": plan.metrics,
            "report": lambda: [f"{self._results}/{REPORT_PAGE}"],
        }
        files = [file for target, find in made.items() if everything or target in asked for file in find()]
        return {os.path.relpath(file, f"{self._results}/{scene}") for file in (*asked, *files)}
