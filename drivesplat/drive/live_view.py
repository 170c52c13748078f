"""What a live viewer shows and changes, without its server: an edit in the making, and the picture of a camera."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from drivesplat.drive.cameras import Matrix, PoseableCamera, require_pose
from drivesplat.drive.pictures import PICTURES, Picture, blended, error_picture, placed
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.editing.actors import trained_actors
from drivesplat.errors import DatasetError, DriveSplatError, RequestError, UnknownObjectError
from drivesplat.io.storage import atomic_write
from drivesplat.io.yaml_file import read_yaml
from drivesplat.scene.images import read_image
from drivesplat.scene.tracks import matching_ids
from drivesplat.settings.edit import MIN_CHROMA
from drivesplat.trajectories.edited_actors import EditedActor, edited_actors
from drivesplat.workflow.edits_file import edit_of, read_edits, require_edit_name

DECIMALS = 3
"""Of the metres and degrees of steps."""
ITERATIONS = 4
"""Steps of the search for a shift that places an object: on a bend its path is no straight line."""
COMMENT = r"(^|\s)#"
"""Where a comment of an edits file begins; colours such as '#ff0000' are in quotes."""
ERROR = "error"
"""The name of the picture of differences from the recorded image."""
PAINTED = 0.3
"""Share of an object's pixels, the most colourful ones, that show its paint."""
MIN_SIZE, MAX_SIZE = 16, 4096
"""Pixels of an edge of a picture."""


@dataclass(frozen=True)
class ObjectChange:
    """What is done to an object during the whole drive: `longitudinal` and `lateral` metres ahead along its path and to
    its left, `yaw` degrees to its left on the spot, its `colour` (None: as recorded) in place of that of its `paint`
    (None: of all its surfaces), and whether it is `removed`."""

    longitudinal: float = 0.0
    lateral: float = 0.0
    yaw: float = 0.0
    colour: str | None = None
    paint: str | None = None
    removed: bool = False

    def steps(self, track: str) -> list[dict[str, Any]]:
        """The steps of an edits file for the object with this id."""
        if self.removed:
            return [{"remove": {"track": track}}]
        moved = {name: getattr(self, name) for name in ("lateral", "longitudinal", "yaw") if getattr(self, name)}
        steps = [{"shift": {"track": track, **moved}}] if moved else []
        if self.colour:
            known = {"from": self.paint} if self.paint else {}
            steps.append({"recolour": {"track": track, **known, "colour": self.colour}})
        return steps


@dataclass
class EditSession:
    """The changes of a drive by object, and those of the ego vehicle: metres to its left, and a factor on its speed.

    Objects are named by the beginnings of their ids. Raises UnknownObjectError for an object that cannot be edited,
    ConfigError for changes beyond the limits of edits (docs/editing.md).

    >>> session = EditSession(drivesplat.open("results/demo/street"))
    >>> session.change("bf53", lateral=2.0)
    >>> session.edited.render("CAM_FRONT", time=4.2).image.shape
    (225, 400, 3)
    """

    drive: TrainedDrive
    changes: dict[str, ObjectChange] = field(default_factory=dict)
    ego_lateral: float = 0.0
    ego_speed: float = 1.0

    def __post_init__(self) -> None:
        if self.drive.edit is not None:
            raise RequestError("an edit begins with a drive as recorded, not with an edited one")
        self.follow(self.drive)

    def follow(self, drive: TrainedDrive) -> None:
        """Goes on with another model of the same drive, such as a later one of the same training."""
        self._recorded = trained_actors(drive.model, drive.scene, drive.where)
        self._made: tuple[list[dict[str, Any]], TrainedDrive] = [], drive
        self.drive = drive
        self.changes = {track: change for track, change in self.changes.items() if track in self.objects}

    @property
    def objects(self) -> list[str]:
        """The ids of the objects that can be edited."""
        return [actor.id for actor in self._recorded]

    def steps(self) -> list[dict[str, Any]]:
        """The steps of an edits file; none without changes."""
        ego = {"lateral": self.ego_lateral} if self.ego_lateral else {}
        ego |= {"speed": self.ego_speed} if self.ego_speed != 1.0 else {}
        own = [step for track, change in self.changes.items() for step in change.steps(track)]
        return own + ([{"ego": ego}] if ego else [])

    @property
    def edited(self) -> TrainedDrive:
        """The drive with all changes."""
        steps = self.steps()
        if self._made[0] != steps:
            self._made = steps, self.drive.edited(steps) if steps else self.drive
        return self._made[1]

    def change_of(self, name: str) -> ObjectChange:
        """What is done to an object."""
        return self.changes.get(self._actor(name).id, ObjectChange())

    def change(self, name: str, **fields: Any) -> None:
        """Changes fields of an object's `ObjectChange`. Nothing is changed where an edit could not do it."""
        track = self._actor(name).id
        rounded = {key: round(value, DECIMALS) if isinstance(value, float) else value for key, value in fields.items()}
        self._attempt({**self.changes, track: ObjectChange(**{**vars(self.change_of(track)), **rounded})})

    def _attempt(self, changes: dict[str, ObjectChange], ego: tuple[float, float] | None = None) -> None:
        """Takes over changes, and perhaps those of the ego vehicle, if they are an edit of the drive."""
        before = self.changes, self.ego_lateral, self.ego_speed
        self.changes = {track: change for track, change in changes.items() if change != ObjectChange()}
        if ego is not None:
            self.ego_lateral, self.ego_speed = ego
        try:
            _ = self.edited
        except DriveSplatError:
            self.changes, self.ego_lateral, self.ego_speed = before
            raise

    def place(self, name: str, object_to_world: Matrix, time: float) -> None:
        """Shifts an object along and across its path so that it stands at a pose (4, 4) at a time in seconds. Its
        height, pitch and roll stay those of its path."""
        wanted, actor = require_pose(object_to_world, f"object {name}"), self._actor(name)
        change = replace(self.change_of(name), removed=False)
        for _ in range(ITERATIONS):
            found = self._pose(actor, change, time)
            turn = np.arctan2(wanted[1, 0], wanted[0, 0]) - np.arctan2(found[1, 0], found[0, 0])
            heading = np.arctan2(found[1, 0], found[0, 0]) - np.radians(change.yaw)
            ahead, left = (np.array([np.cos(heading + a), np.sin(heading + a)]) for a in (0.0, 0.5 * np.pi))
            missing = (wanted - found)[:2, 3]
            change = replace(
                change,
                longitudinal=round(float(change.longitudinal + missing @ ahead), DECIMALS),
                lateral=round(float(change.lateral + missing @ left), DECIMALS),
                yaw=round(float((np.degrees(turn) + change.yaw + 180.0) % 360.0 - 180.0), DECIMALS),
            )
        self._attempt({**self.changes, actor.id: change})

    def change_ego(self, lateral: float, speed: float) -> None:
        """Moves the ego vehicle to its left by metres, at a factor on its speed. Nothing is changed where an edit could
        not do it."""
        self._attempt(self.changes, (round(lateral, DECIMALS), round(speed, DECIMALS)))

    def reset(self, name: str) -> None:
        """Takes back all changes of an object."""
        gone = self._actor(name).id
        self.changes = {track: change for track, change in self.changes.items() if track != gone}

    def write(self, path: str | Path, name: str) -> None:
        """Writes the steps as the edit `name` into an edits file; other edits of the file stay.

        Raises RequestError without a change, and for a file with comments, which would be lost; ConfigError for a name
        that no edit may have, and where the file is no edits file.
        """
        path, steps, known = Path(path), self.steps(), {}
        if not steps:
            raise RequestError("nothing has been changed: there is no edit to write")
        require_edit_name(name, f"{path}: edit")
        if path.exists():
            read_edits(path)
            if re.search(COMMENT, path.read_text(encoding="utf-8"), flags=re.MULTILINE):
                raise RequestError(f"{path} has comments, which would be lost: name another file")
            known = read_yaml(path, "edits file")["edits"] or {}
        content = {"edits": {**known, name: steps}}
        with atomic_write(path) as file:
            file.write(yaml.safe_dump(content, sort_keys=False, allow_unicode=True).encode())

    def _actor(self, name: str) -> EditedActor:
        found = matching_ids(name, self.objects)
        if len(found) != 1 or not name:
            raise UnknownObjectError(f"no single object that can be edited has an id starting with {name!r}")
        return next(actor for actor in self._recorded if actor.id == found[0])

    def _pose(self, actor: EditedActor, change: ObjectChange, time: float) -> np.ndarray:
        """The pose of an object after a change."""
        if steps := change.steps(actor.id):
            (actor,) = edited_actors([actor], edit_of(steps, f"object {actor.id}"), self.drive.where)
        return actor.poses(np.array([time]))[0]


@dataclass(frozen=True)
class FreeCamera:
    """A camera that the user moves: its pose (4, 4) (x right, y down, z forward) and its vertical field of view in
    radians."""

    camera_to_world: np.ndarray
    vertical_fov: float

    def is_near(self, other: "FreeCamera") -> bool:
        """Whether another camera has the same place and direction but for rounding."""
        return bool(np.allclose(self.camera_to_world, other.camera_to_world, atol=1e-3))

    def sized(self, width: int, height: int) -> PoseableCamera:
        """The camera with images of this size."""
        focal = 0.5 * height / np.tan(0.5 * self.vertical_fov)
        K = np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
        return PoseableCamera(width, height, K)


@dataclass
class LiveView:
    """What is looked at: an edit in the making of each of several methods of one drive, a time in seconds, and what is
    shown. `beside` is the number of a second method, shown in the right half of the picture. `recorded` is the share of
    the recorded image that lies over the rendering where the view follows a recorded camera."""

    sessions: Sequence[EditSession]
    time: float = 0.0
    method: int = 0
    beside: int | None = None
    shows: str = "colour"
    follow: str | None = None
    recorded: float = 0.0
    _images: dict[int, Picture] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        if not self.sessions:
            raise RequestError("there is no drive to look at")
        names = {session.drive.scene.name for session in self.sessions}
        if len(names) > 1:
            raise RequestError(f"the methods are of different scenes: {', '.join(sorted(names))}")

    @property
    def session(self) -> EditSession:
        """The edit of the method that is shown."""
        return self.sessions[self.method]

    @property
    def drive(self) -> TrainedDrive:
        """The drive of that method, with its edit."""
        return self.session.edited

    def followed(self) -> FreeCamera | None:
        """The camera that the view follows, at this time; None where the user moves the camera, or it does not record
        then."""
        if self.follow is None:
            return None
        try:
            pose = self.drive.camera_to_world(self.follow, self.time)
        except RequestError:
            return None
        camera = self.drive.camera(self.follow)
        return FreeCamera(pose, 2.0 * np.arctan(0.5 * camera.height / camera.K[1, 1]))

    def picture(self, free: FreeCamera, width: int, height: int) -> Picture:
        """What a window of this size in pixels shows from `free`. Where a recorded image is wanted, it shows the time
        of the nearest image of the camera that the view follows, with the principal point in the middle of the
        window."""
        width, height = (int(np.clip(edge, MIN_SIZE, MAX_SIZE)) for edge in (width, height))
        followed = self.followed()
        index = self.nearest_image() if self.recorded or self.shows == ERROR else None
        if followed is None or self.follow is None or index is None:
            return self._compared(free.sized(width, height), free.camera_to_world, None)
        camera = self.drive.camera(self.follow, exposure=self.shows == ERROR)
        camera = camera.resized(max(MIN_SIZE, round(camera.width * height / camera.height)))
        frame = self.session.drive.scene.frames[index]
        at = replace(self, time=self.session.drive.scene.seconds(frame.timestamp))
        there = at.followed() or followed
        picture = at._compared(camera, there.camera_to_world, self._recorded(index, camera))
        return placed(picture, camera.K[:2, 2], width, height)

    def _compared(self, camera: PoseableCamera, pose: np.ndarray, recorded: Picture | None) -> Picture:
        left = self._rendered(self.session.edited, camera, pose, recorded)
        if self.beside is None:
            return left
        right = self._rendered(self.sessions[self.beside].edited, camera, pose, recorded)
        middle = left.shape[1] // 2
        return np.concatenate([left[:, :middle], right[:, middle:]], axis=1)

    def _rendered(
        self, drive: TrainedDrive, camera: PoseableCamera, pose: np.ndarray, recorded: Picture | None
    ) -> Picture:
        output, draw = PICTURES["colour" if self.shows == ERROR else self.shows]
        picture = draw(drive.render(camera, self.time, camera_to_world=pose, outputs=[output], outside="clamp"))
        if recorded is None:
            return picture
        if self.shows == ERROR:
            return error_picture(picture, recorded)
        return blended(picture, recorded, self.recorded)

    def paint_of(self, track: str) -> str | None:
        """The colour of an object's paint, as an edits file writes it, in the image that is followed, or else of the
        first camera: the median of its most colourful pixels. None for a grey one, and where it is not seen."""
        drive = self.session.drive
        camera = self.follow or next(iter(drive.cameras), None)
        if camera is None:
            return None
        view = drive.render(camera, self.time, outputs=["rgb", "instance"], outside="clamp")
        if track not in view.objects:
            return None
        pixels = view.image[view.arrays()["instance"] == view.objects.index(track)].astype(float)
        if not len(pixels):
            return None
        chroma = np.ptp(pixels, axis=1)
        paint = np.median(pixels[chroma >= np.quantile(chroma, 1.0 - PAINTED)], axis=0)
        return None if np.ptp(paint) < 255.0 * MIN_CHROMA else "#{:02x}{:02x}{:02x}".format(*paint.round().astype(int))

    def nearest_image(self) -> int | None:
        """The index in `scene.frames` of the image of the followed camera that is nearest in time."""
        scene = self.session.drive.scene
        own = [i for i, frame in enumerate(scene.frames) if frame.camera == self.follow]
        return min(own, key=lambda i: abs(scene.seconds(scene.frames[i].timestamp) - self.time), default=None)

    def _recorded(self, index: int, camera: PoseableCamera) -> Picture | None:
        if index not in self._images:
            self._images.clear()
            try:
                self._images[index] = read_image(self.session.drive.scene.frames[index].image_path)
            except DatasetError:  # the dataset is elsewhere
                return None
        size = camera.width, camera.height
        return cv2.resize(self._images[index], size, interpolation=cv2.INTER_AREA)


def describe(drive: TrainedDrive, name: str) -> str:
    """An object of a drive in words."""
    track = drive.scene.track(name)
    if track is None:
        return name[:8]
    table = drive.actors
    speed = f", up to {table.loc[name, 'speed']:.0f} m/s" if name in table.index else ""
    return f"{track.object_class.value} {name[:8]}{speed}"


def wxyz_of(pose: np.ndarray) -> np.ndarray:
    """The quaternion (4,) of a pose (4, 4), w first."""
    return Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
