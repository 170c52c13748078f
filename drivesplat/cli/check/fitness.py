"""What a recording means for each method: whether it can be trained, and what it makes of the recording."""

import re
from collections.abc import Iterator
from typing import Any, NamedTuple

from drivesplat.cli.check.chosen import ChosenScene, config_of
from drivesplat.cli.check.contents import class_counts
from drivesplat.cli.check.reading import mean_rate
from drivesplat.readers.outline import Outline
from drivesplat.scene.scene import Scene
from drivesplat.scene.tracks import moving_tracks
from drivesplat.settings.config import Config, for_scene
from drivesplat.workflow.recording_faults import faults_of
from drivesplat.workflow.stages import SCANS, stages_of_metrics, track_stages, training_inputs
from drivesplat.workflow.without_cameras import has_cameras
from drivesplat.workflow.without_tracks import methods_of

PRESETS = (
    "presets/people.yaml",
    "presets/lidar.yaml",
    "presets/without_boxes.yaml",
    "presets/people_without_boxes.yaml",
)
"""Config files that add methods."""
OWN = ("by default", "of the config file")
"""Sources of methods that are trained without a preset: where settings are proposed, and with a config file."""


class Verdict(NamedTuple):
    """What a recording means for a `method`, which is there by default or with the config file `source`: `fault` is why
    it cannot be trained (None: it can), `notes` what it makes of the recording."""

    method: str
    source: str
    fault: str | None
    notes: list[str]

    def __str__(self) -> str:
        said = f"not on this recording: {self.fault}" if self.fault else "; ".join(self.notes)
        return f"{self.method} ({self.source}): {said}"


def verdicts(chosen: ChosenScene, settings: dict[str, Any], scene: Scene, outline: Outline) -> Iterator[Verdict]:
    """The verdicts on the methods of a config and those that presets add."""
    config, name = config_of(chosen, settings), chosen.name
    own, given = methods_of(config, name), OWN[chosen.of_config]
    yield from (_verdict(config, scene, outline, name, method, given) for method in own)
    known = {*own, *config.methods}
    for preset in PRESETS:
        there = config_of(chosen, settings, preset)
        for method in [other for other in there.methods if other not in known]:
            known.add(method)
            yield _verdict(there, scene, outline, name, method, preset)


def _verdict(config: Config, scene: Scene, outline: Outline, name: str, method: str, source: str) -> Verdict:
    return Verdict(method, source, _fault(config, outline, name, method), list(_notes(config, scene, name, method)))


def _fault(config: Config, outline: Outline, name: str, method: str) -> str | None:
    """Why a method cannot be trained on a scene."""
    if not has_cameras(config, name) and for_scene(config, name, method).train.scans.per_image == 0:
        return "it renders images alone, and there are none"
    stages = [*stages_of_metrics(config, name)[0], *training_inputs(config, name, method)]
    config.outlines[name] = outline
    fault = next(faults_of(config, name, {*stages, *track_stages(config, name, method)}), None)
    return None if fault is None else re.sub(r"^scene \S+(:|,| has) ", "", fault).partition(";")[0]


def _notes(config: Config, scene: Scene, name: str, method: str) -> Iterator[str]:
    settings, found = config.all_methods[method], for_scene(config, name, method)
    moving = moving_tracks(scene)
    if settings.tracks == "discovered":
        rate = mean_rate([sweep.timestamp for sweep in scene.sweeps if sweep.is_key_frame or found.scans.sweeps])
        yield "objects are found in LiDAR scans" + (f" at {rate:.3g} Hz" if rate else "")
    elif settings.object_parts:
        parts = {track.id: found.actors.parts_of(track.object_class.value) for track in moving}
        own = [track for track in moving if set(parts[track.id]) & set(settings.object_parts)]
        rest = [track for track in moving if track not in own]
        counts = class_counts(track.object_class.value for track in own)
        yield f"moving objects: {counts}" if counts else "no object of its own: none of its classes moves or has boxes"
        if rest:
            yield f"these blur: {class_counts(track.object_class.value for track in rest)}"
    elif settings.moving_parts:
        yield "moving things drift" if not scene.tracks else "moving things drift; boxes are not used"
    else:
        yield "moving things blur" if moving or not scene.tracks else "nothing moves, by the boxes"
    if SCANS in training_inputs(config, name, method):
        yield f"renders LiDAR {', '.join(lidar.name for lidar in scene.lidars)}"
    elif found.train.depth_weight > 0:
        yield "LiDAR gives depth" if scene.sweeps else "no depth, without LiDAR"
