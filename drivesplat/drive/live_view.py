"""What a live viewer shows, without its server: the state that controls change, and the picture of a camera."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from drivesplat.drive.cameras import PoseableCamera
from drivesplat.drive.edit_session import EditSession
from drivesplat.drive.pictures import PICTURES, Picture, blended, error_picture, placed
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.errors import DatasetError, RequestError
from drivesplat.scene.images import read_image

ERROR = "error"
"""The name of the picture of differences from the recorded image."""
MIN_SIZE, MAX_SIZE = 16, 4096
"""Pixels of an edge of a picture."""


@dataclass(frozen=True)
class FreeCamera:
    """A camera that the user moves: its pose (4, 4) (x right, y down, z forward) and its vertical field of view in
    radians."""

    camera_to_world: np.ndarray
    vertical_fov: float

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
        """What a window of this size in pixels shows from `free`. Where a recorded image is wanted, it is the image of
        the camera that the view follows, with the principal point in the middle of the window."""
        width, height = (int(np.clip(edge, MIN_SIZE, MAX_SIZE)) for edge in (width, height))
        followed = self.followed()
        if followed is None or self.follow is None or not (self.recorded or self.shows == ERROR):
            return self._compared(free.sized(width, height), free.camera_to_world, None)
        camera = self.drive.camera(self.follow)
        camera = camera.resized(max(MIN_SIZE, round(camera.width * height / camera.height)))
        picture = self._compared(camera, followed.camera_to_world, self._recorded(camera))
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

    def nearest_image(self) -> int | None:
        """The index in `scene.frames` of the image of the followed camera that is nearest in time."""
        scene = self.session.drive.scene
        own = [i for i, frame in enumerate(scene.frames) if frame.camera == self.follow]
        return min(own, key=lambda i: abs(scene.seconds(scene.frames[i].timestamp) - self.time), default=None)

    def _recorded(self, camera: PoseableCamera) -> Picture | None:
        index = self.nearest_image()
        if index is None:
            return None
        if index not in self._images:
            self._images.clear()
            try:
                self._images[index] = read_image(self.session.drive.scene.frames[index].image_path)
            except DatasetError:  # the dataset is elsewhere
                return None
        size = camera.width, camera.height
        return cv2.resize(self._images[index], size, interpolation=cv2.INTER_AREA)
