"""The fields of the records of stages that render trajectories and edits: films, drive folders and LiDAR scans."""

from dataclasses import replace
from typing import Any

from drivesplat.errors import ConfigError
from drivesplat.workflow.film_names import EDITS, no_such_edit, no_such_film, scene_edits
from drivesplat.workflow.job_scope import JobScope
from drivesplat.workflow.without_cameras import HOW, no_camera


def film_format(at: JobScope) -> dict[str, Any]:
    """Of a `FilmFormat`."""
    fields = ("fps", "width", "height", "horizontal_fov", "crf", "captions")
    return {"camera": at.config.eval_camera, **{name: getattr(at.config.render, name) for name in fields}}


def film(at: JobScope) -> dict[str, Any]:
    """Of a `FilmJob`. Raises ConfigError for an unknown trajectory."""
    trajectories = at.config.render.trajectories
    if at.film not in trajectories:
        raise ConfigError(no_such_film(at.config, f"dataset {at.dataset_name}", at.film))
    return {"trajectory": trajectories[at.film], **film_format(at)}


def quad(at: JobScope) -> dict[str, Any]:
    """Of an `EditJob`, without `frames`. Raises ConfigError for an unknown edit."""
    edits = scene_edits(at.config, at.scene)
    if at.film not in edits:
        raise ConfigError(no_such_edit(at.scene, at.film, edits))
    return {"edit": edits[at.film], **film_format(at)}


def _edit_or_trajectory(at: JobScope) -> dict[str, Any]:
    kind, _, name = at.film.partition("/")
    of_film = replace(at, film=name)
    return {"edit": quad(of_film)["edit"]} if kind == EDITS else {"trajectory": film(of_film)["trajectory"]}


def drive_folder(at: JobScope) -> dict[str, Any]:
    """Of a `DriveJob`; raises as `quad` or `film`."""
    return {**_edit_or_trajectory(at), "width": at.config.export.drive_width}


def scan_folder(at: JobScope) -> dict[str, Any]:
    """Of a `ScanFolderJob`; raises as `quad` or `film`, and ConfigError for an edit of a scene without cameras."""
    camera = at.config.eval_camera if at.config.cameras else None
    if camera is None and at.film.startswith(f"{EDITS}/"):
        raise ConfigError(f"{no_camera(at.scene)}: scans of edits need images; {HOW}")
    return {**_edit_or_trajectory(at), "eval_camera": camera, "formats": at.config.export.scan_formats}


def encoding(at: JobScope) -> dict[str, Any]:
    """How films that combine others are encoded."""
    return {name: getattr(at.config.render, name) for name in ("crf", "captions")}
