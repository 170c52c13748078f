"""The inputs and settings of the report across scenes."""

from pathlib import Path
from typing import Any

from drivesplat.errors import ConfigError
from drivesplat.io.storage import canonical_json
from drivesplat.settings.report import HELD_OUT_PAIR, LIDAR_LOOKS, LOOKS, ReportJob
from drivesplat.workflow.film_names import FILM_PAGE
from drivesplat.workflow.outputs import Outputs
from drivesplat.workflow.runs_file import RUNS
from drivesplat.workflow.without_cameras import has_cameras

EVERYTHING = "all"
REPORT_RULES = ("gap_report", "report")
REPORT_FILES = ("gap_report.html", "gap_report.json", "gap_report.csv", "ghosts.html", ".report/gap_report.html")
"""The last is the page for Snakemake's report: its links are those of the archive."""


class ReportPlan:
    """The report of a `plan` for some `targets`: of all scenes, or of the measured ones where it is the only target. It
    shows the pictures and names the films that exist, where everything is a target all of them. Runs that are targets
    beside it are in its table, too.

    The inputs and settings are functions of wildcards: Snakemake calls them only if the report is to be made.
    """

    def __init__(self, plan: Outputs, targets: list[str]):
        self._plan = plan
        self._results = plan.config.results_dir
        names = {*REPORT_RULES, *(f"{self._results}/{name}" for name in REPORT_FILES)}
        self._alone = bool(targets) and set(targets) <= names
        self._everything = not targets or EVERYTHING in targets
        self._targets = frozenset(targets)
        self.wanted = self._everything or bool(set(targets) & names)

    @property
    def scenes(self) -> list[str]:
        scenes = self._plan.config.batch_scenes
        if not self._alone:
            return scenes
        return [scene for scene in scenes if Path(self._results, scene, "metrics.json").is_file()]

    def refuse_empty(self) -> None:
        """Raises ConfigError if the report is the only target and excludes all scenes that have been measured, since
        their datasets are not in the batch."""
        batch = set(self._plan.config.batch_scenes)
        others = [scene for scene in self._plan.config.scenes if scene not in batch]
        measured = [scene for scene in others if Path(self._results, scene, "metrics.json").is_file()]
        if self._alone and measured and not self.scenes:
            raise ConfigError(
                f"no scene of the report has been measured; {', '.join(measured)} has, and is no part of it "
                "(datasets.<name>.batch: false): with --configfile presets/demo.yaml -- report it is the demo's report"
            )

    def metrics(self, _: Any = None) -> list[str]:
        """The metrics.json of its scenes."""
        return [f"{self._results}/{scene}/metrics.json" for scene in self.scenes]

    def pictures(self, _: Any = None) -> list[str]:
        """The pictures that its page shows. Every metrics.json comes with a pair of held-out images."""
        with_figures = self._plan.of_methods(lambda *_: HELD_OUT_PAIR.values(), self.scenes)
        looks = self._plan.of_methods(self._looks, self.scenes, cameras=False)
        return [*_chosen(with_figures, not self._alone), *_chosen(looks, self._everything)]

    def runs(self, _: Any = None) -> list[str]:
        """The records of runs in its scenes, those that are targets beside the report included."""
        runs = self._plan.runs(scenes=self.scenes)
        wanted = {*runs} if self._everything or RUNS in self._targets else self._targets
        return [file for file in runs if file in wanted or Path(file).is_file()]

    def links(self, _: Any = None) -> list[str]:
        """The files that its page links to: films, pages of films, edits and viewers, in an order that does not depend
        on files of settings."""
        viewers = self._plan.of_methods(lambda *_: ["viewer.html"], self.scenes)
        films, edits = self._plan.films(scenes=self.scenes), self._plan.edits(scenes=self.scenes)
        pages = [f"{self._results}/{scene}/{FILM_PAGE}" for scene in self.scenes]
        return _chosen(sorted([*films, *edits, *viewers, *pages]), self._everything)

    def settings(self, _: Any = None) -> str:
        """The settings of its job as canonical JSON."""
        config = self._plan.config
        static_methods = (name for name, method in config.methods.items() if not method.moving_parts)
        job = ReportJob(
            expected={scene: self._plan.metrics_stages(scene) for scene in config.batch_scenes},
            reference=next(static_methods, None),
            random_seed=config.random_seed,
            published=config.published,
        )
        return canonical_json(job.model_dump(mode="json"))

    def _looks(self, scene: str, method: str) -> list[str]:
        of_images = LOOKS.values() if has_cameras(self._plan.config, scene) else ()
        return [*of_images, *(LIDAR_LOOKS.values() if self._plan.renders_lidar(scene, method) else ())]


def _chosen(files: list[str], every: bool) -> list[str]:
    """All of the files, or those that exist."""
    return [file for file in files if every or Path(file).is_file()]
