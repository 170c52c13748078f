"""The live viewer in the browser: viser's window and controls, with images that this process renders.

viser is an optional package (docs/live_viewer.md). Images are small while something moves, and have the size of the
window when it rests.
"""

import itertools
import logging
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.drive.live_controls import LiveControls
from drivesplat.drive.live_view import EditSession, FreeCamera, LiveView, describe, wxyz_of
from drivesplat.drive.pictures import name_colors, with_rest
from drivesplat.drive.trained_drive import TrainedDrive, open_drive
from drivesplat.drive.world_actor import WorldActor
from drivesplat.errors import DriveSplatError, RequestError
from drivesplat.model.checkpoint import model_file
from drivesplat.scene.rigid import rigid
from drivesplat.scene.tracks import UNIT_CORNERS

log = logging.getLogger(__name__)

REST_S = 0.3
"""Seconds without a change after which an image has the size of the window."""
SMALL, LARGEST = 320, 1920
"""Width in pixels of the images of a CPU while something moves, and of the largest images."""
MOVING_SHARE = 0.5
"""Share of the window's width that images of a GPU have while something moves."""
QUALITY = {False: 80, True: 95}
"""JPEG quality of images while something moves, and at rest."""
POLL_S, PAUSE_S = 0.005, 1.0
"""Seconds between two looks for changes, and between two looks for the end."""
LOOK_EVERY_S = 2.0
"""Seconds between two looks for later states of a training."""
FIRST_FOV = 1.0
"""Vertical field of view in radians of a window that follows no camera."""
FRUSTUM_EVERY = 5
"""Every this many-th key frame is drawn as a camera."""
EDGES = np.array([(a, b) for a, b in itertools.combinations(UNIT_CORNERS, 2) if np.abs(a - b).sum() == 1.0])
"""The edges (12, 2, 3) of a box with edges of length 1."""
MAX_POINTS = 100_000
"""LiDAR returns that are sent at once."""


class Overlays:
    """The nodes of viser's scene `nodes` for a view. `select` is called with the id of an object that is clicked."""

    def __init__(self, nodes: Any, view: LiveView, select: Callable[[str], None]):
        self._nodes, self._view, self._select = nodes, view, select
        self._boxes: dict[str, list[Any]] = {}
        self._frustums = nodes.add_frame("/cameras", show_axes=False, visible=False)
        for number, frame in enumerate(view.session.drive.scene.frames):
            if frame.is_key_frame and frame.sample_index % FRUSTUM_EVERY == 0:
                pose, fov = frame.camera_to_world, 2.0 * np.arctan(0.5 * frame.height / frame.intrinsics[1, 1])
                nodes.add_camera_frustum(
                    f"/cameras/{number}", float(fov), frame.width / frame.height, scale=0.5,
                    wxyz=wxyz_of(pose), position=pose[:3, 3],
                )  # fmt: skip

    def show_cameras(self, visible: bool) -> None:
        """Shows or hides the recorded cameras."""
        self._frustums.visible = visible

    def draw_boxes(self, visible: bool) -> None:
        """Draws the boxes of the objects that can be edited, at the time of the view; those that are removed where they
        were recorded."""
        session, shown = self._view.session, dict[str, WorldActor]()
        if visible:
            drives = [session.drive] if any(change.removed for change in session.changes.values()) else []
            for drive in (*drives, session.edited):
                shown |= drive.state(self._view.time, outside="clamp").actors
        for name in self._boxes.keys() - shown.keys():
            for handle in self._boxes.pop(name):
                handle.remove()
        for name, actor in shown.items():
            pose = actor.pose
            if name not in self._boxes:
                self._boxes[name] = self._new_box(name, actor.size)
            for handle in self._boxes[name]:
                handle.position, handle.wxyz = pose[:3, 3], wxyz_of(pose)

    def _new_box(self, name: str, size: np.ndarray) -> list[Any]:
        color = tuple(name_colors([name])[0].tolist())
        key, edges = f"/objects/{name.replace('/', '_')}", tuple(size.tolist())
        box = self._nodes.add_box(f"{key}/box", color, edges, opacity=0.15)
        lines = self._nodes.add_line_segments(f"{key}/lines", size * EDGES, colors=color)
        label = self._nodes.add_label(f"{key}/label", describe(self._view.session.drive, name))
        box.on_click(lambda _: self._select(name))
        return [box, lines, label]

    def draw_points(self, visible: bool) -> None:
        """Draws the returns of the first LiDAR at the time of the view, in the colours of their objects."""
        if not visible:
            self._nodes.remove_by_name("/lidar")
            return
        drive = self._view.drive
        scan = drive.scan(drive.lidars[0], self._view.time, outside="clamp")
        arrays, points = scan.arrays(), scan.points()
        numbers = arrays["instance"][arrays["returned"]]
        chosen = slice(None, None, max(1, len(points) // MAX_POINTS))
        colors = with_rest(name_colors(scan.objects))
        self._nodes.add_point_cloud(
            "/lidar", points[chosen].astype(np.float32), colors[numbers[chosen]], point_size=0.06
        )


@dataclass
class WindowState:
    """The image of a browser window: what it `shows`, since when, and whether it has the size of the window; and when
    its camera was `placed` last, by `time.monotonic`."""

    shows: tuple = ()
    since: float = 0.0
    whole: bool = True
    placed: float = 0.0


class LiveServer:
    """A live viewer of one or several methods of a drive. `url` is its address, by default on this machine alone.

    Edits are written into `edits_file`. `close` ends it. Raises RequestError where viser is missing or the port is in
    use, and for methods of different scenes.

    >>> server = LiveServer([drivesplat.open("results/demo/street")])
    >>> server.wait()
    """

    def __init__(
        self,
        drives: Sequence[TrainedDrive],
        host: str = "127.0.0.1",
        port: int = 8080,
        edits_file: str | Path = "my_edits.yaml",
    ):
        view = LiveView([EditSession(drive) for drive in drives])
        viser = _viser()
        _require_free(host, port)
        self._server = viser.ViserServer(host=host, port=port, verbose=False, label="drivesplat")
        self._server.scene.set_up_direction("+z")
        self.url = f"http://{host}:{port}"
        self.view, self.controls = view, LiveControls(self._server, view, Path(edits_file))
        self._overlays = Overlays(self._server.scene, view, self.controls.click)
        self._closed, self._windows = threading.Event(), dict[int, WindowState]()
        self._stamps = [_stamp(drive) for drive in drives]
        self._drawn = self._failed = -1
        self._followed: FreeCamera | None = None
        self._server.on_client_connect(self._connected)
        self._server.on_client_disconnect(lambda client: self._windows.pop(client.client_id, None))
        self._worker = threading.Thread(target=self._work, name="drivesplat-viewer", daemon=True)
        self._worker.start()

    def wait(self) -> None:
        """Returns when the viewer has been closed."""
        while not self._closed.wait(PAUSE_S):
            pass

    def close(self) -> None:
        """Ends the server."""
        self._closed.set()
        self._worker.join()
        self._server.stop()

    def _connected(self, client: Any) -> None:
        with self.controls.lock:
            followed, drive = self.view.followed(), self.view.drive
            if followed is None and drive.cameras:
                pose = self.view.session.drive.camera_to_world(drive.cameras[0], 0.0)
                followed = FreeCamera(pose, FIRST_FOV)
        if followed is not None:
            _set_camera(client.camera, followed)
        self._windows[client.client_id] = WindowState()

    def _follow_trainings(self) -> None:
        """Goes on with the models of trainings that have saved a later state, or have ended."""
        for i, session in enumerate(self.view.sessions):
            stamp = _stamp(session.drive)
            if stamp in (None, self._stamps[i]):
                continue
            self._stamps[i] = stamp
            try:
                later = open_drive(session.drive.folder, session.drive.device.type)
            except DriveSplatError as error:  # the training has just removed the state
                log.info("%s", error)
                continue
            with self.controls.lock:
                session.follow(later)
                self.controls.version += 1

    def _work(self) -> None:
        last = looked = time.monotonic()
        while not self._closed.wait(POLL_S):
            now = time.monotonic()
            if now - looked > LOOK_EVERY_S:
                looked = now
                self._attempt(self._follow_trainings)
            last, seconds = now, now - last
            self._attempt(lambda seconds=seconds: self._step(seconds))
            for client in self._server.get_clients().values():
                self._attempt(lambda client=client: self._show(client))

    def _attempt(self, part: Callable[[], None]) -> None:
        """Does a part of the loop. An error is shown once for each change, and the rest goes on."""
        try:
            part()
        except Exception as error:
            if self._failed != self.controls.version:
                self._failed = self.controls.version
                self.controls.report(error)

    def _step(self, seconds: float) -> None:
        """Plays the drive, and draws what lies over the picture where something has changed."""
        controls = self.controls
        with controls.lock:
            controls.place_dragged()
            controls.advance(seconds)
            if self._drawn == controls.version:
                return
            self._drawn = controls.version
            self._followed = self.view.followed()
            self._overlays.show_cameras(bool(controls.cameras.value))
            self._overlays.draw_boxes(bool(controls.boxes.value))
            try:
                self._overlays.draw_points(bool(controls.points.value))
            except DriveSplatError:
                controls.points.value = False
                raise

    def _show(self, client: Any) -> None:
        """Renders the image of a window, if anything has changed or come to rest."""
        window, camera, now = self._windows.get(client.client_id), client.camera, time.monotonic()
        if window is None or not camera.image_height:
            return
        followed, turn = self._followed, Rotation.from_quat(camera.wxyz, scalar_first=True).as_matrix()
        own = FreeCamera(rigid(turn, np.array(camera.position)), float(camera.fov))
        if followed is not None and not followed.is_near(own) and now - window.placed > REST_S:
            _set_camera(camera, followed)
            window.placed = now
        free = own if followed is None else followed
        size = camera.image_width, camera.image_height
        shows = self._drawn, free.camera_to_world.tobytes(), free.vertical_fov, size
        moved = shows != window.shows
        if not moved and (window.whole or now - window.since < REST_S):
            return
        window.shows, window.whole = shows, not moved
        window.since = now if moved else window.since
        with self.controls.lock:
            picture = self.view.picture(free, *self._size_of(size, whole=not moved))
        client.scene.set_background_image(picture, format="jpeg", jpeg_quality=QUALITY[not moved])
        if followed is not None:
            _set_camera(camera, followed)
            window.placed = now

    def _size_of(self, window: tuple[int, int], whole: bool) -> tuple[int, int]:
        """The width and height of an image in pixels for a window of this size."""
        width = min(window[0], LARGEST)
        if not whole:
            on_cpu = self.view.session.drive.device.type == "cpu"
            width = min(width, SMALL if on_cpu else max(SMALL, round(MOVING_SHARE * width)))
        return width, max(1, round(width * window[1] / window[0]))


def _stamp(drive: TrainedDrive) -> tuple[str, int] | None:
    """What tells the files of a drive's model apart; None where there is none."""
    try:
        file = model_file(drive.folder)
        return file.name, file.stat().st_mtime_ns
    except (RequestError, FileNotFoundError):
        return None


def _set_camera(camera: Any, to: FreeCamera) -> None:
    """Moves the camera of a window."""
    pose = to.camera_to_world
    camera.position, camera.wxyz, camera.fov = pose[:3, 3], wxyz_of(pose), to.vertical_fov


def _viser() -> Any:
    try:
        import viser
    except ImportError:
        raise RequestError(
            "the live viewer needs the package viser: pip install 'viser>=1.1,<2' into the environment of drivesplat"
        ) from None
    return viser


def _require_free(host: str, port: int) -> None:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or error
            raise RequestError(f"the viewer cannot use {host}:{port} ({reason}); choose another --port") from None
