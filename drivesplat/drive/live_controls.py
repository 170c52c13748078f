"""The controls of a live viewer: what is shown, and how objects and the vehicle are changed."""

import logging
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.drive.live_view import ERROR, EditSession, LiveView, describe, wxyz_of
from drivesplat.drive.pictures import PICTURES
from drivesplat.errors import DriveSplatError, RequestError

log = logging.getLogger(__name__)

FREE, SAME = "none (free camera)", "the same"
"""The entries with which the user moves the camera, and with which both halves show one method."""
CLICK = "Click an object."


class LiveControls:
    """The controls of viser's `server` for a view. Edits are written into `edits_file`. `version` counts the changes;
    `lock` is held while one is made."""

    def __init__(self, server: Any, view: LiveView, edits_file: Path):
        self.view, self.edits_file, self.version, self.lock = view, edits_file, 0, threading.RLock()
        self.selected: str | None = None
        self._server, self._handle, self._dragged = server, None, False
        self._names = [f"{session.drive.folder.name} ({i + 1})" for i, session in enumerate(view.sessions)]
        self._add_of_view()
        self._add_of_edit()
        self._choose_camera()

    def _add_of_view(self) -> None:
        gui, drive = self._server.gui, self.view.session.drive
        with gui.add_folder("Drive"):
            end = np.floor(100.0 * drive.duration) / 100.0
            self.time = gui.add_slider("seconds", 0.0, float(end), 0.01, 0.0)
            self.play = gui.add_checkbox("play", False)
            cameras = [FREE, *drive.cameras]
            self.follow = gui.add_dropdown("follow", cameras, initial_value=cameras[min(1, len(cameras) - 1)])
            self.shows = gui.add_dropdown("show", [*PICTURES, ERROR], initial_value="colour")
            self.recorded = gui.add_slider("recorded image", 0.0, 1.0, 0.05, 0.0)
            if len(self._names) > 1:
                self.method = gui.add_dropdown("method", self._names, initial_value=self._names[0])
                self.beside = gui.add_dropdown("right half", [SAME, *self._names], initial_value=SAME)
                self._on(self.method, self._choose_methods)
                self._on(self.beside, self._choose_methods)
            self.boxes = gui.add_checkbox("objects", True)
            self.cameras = gui.add_checkbox("recorded cameras", False)
            self.points = gui.add_checkbox("LiDAR", False, disabled=not drive.renders_lidar)
        self._on(self.time, self._set_time)
        self._on(self.follow, self._choose_camera)
        self._on(self.shows, self._choose_picture)
        self._on(self.recorded, self._choose_picture)
        for handle in (self.play, self.boxes, self.cameras, self.points):
            self._on(handle, lambda: None)

    def _add_of_edit(self) -> None:
        gui = self._server.gui
        with gui.add_folder("Edit"):
            self.message = gui.add_markdown(CLICK)
            self.lateral = gui.add_number("to its left (m)", 0.0, min=-50.0, max=50.0, step=0.1)
            self.longitudinal = gui.add_number("ahead (m)", 0.0, min=-200.0, max=200.0, step=0.1)
            self.yaw = gui.add_number("turned left (degrees)", 0.0, min=-180.0, max=180.0, step=1.0)
            self.removed = gui.add_checkbox("removed", False)
            self.colour = gui.add_rgb("colour", (200, 30, 30))
            paint, reset = gui.add_button("paint"), gui.add_button("as recorded")
            self.ego_lateral = gui.add_number("vehicle to its left (m)", 0.0, min=-50.0, max=50.0, step=0.1)
            self.ego_speed = gui.add_number("factor on its speed", 1.0, min=0.0, max=10.0, step=0.05)
            self.name = gui.add_text("name of the edit", "mine")
            write = gui.add_button(f"write {self.edits_file.name}")
        for handle in (self.lateral, self.longitudinal, self.yaw, self.removed):
            self._on(handle, self._edit_selected)
        for handle in (self.ego_lateral, self.ego_speed):
            self._on(handle, self._edit_ego)
        for button, change in ((paint, self._paint), (reset, self._reset), (write, self._write)):
            self._on_click(button, change)

    def _on(self, handle: Any, change: Callable[[], None]) -> None:
        """Calls `change` where a user moves a control, not where this program does."""
        handle.on_update(lambda event: self.changing(change) if event.client is not None else None)

    def _on_click(self, button: Any, change: Callable[[], None]) -> None:
        button.on_click(lambda _: self.changing(change))

    def changing(self, change: Callable[[], None]) -> None:
        """Makes a change, or shows in the window why it cannot be made."""
        with self.lock:
            try:
                change()
            except Exception as error:
                self.report(error)
                self._show_change()
            self.version += 1

    def report(self, error: Exception) -> None:
        """Shows an error in every window, and one that is no fault of the user's in the log, too."""
        if not isinstance(error, DriveSplatError):
            log.error("the live viewer", exc_info=error)
        self.say(str(error) or type(error).__name__)

    def say(self, text: str) -> None:
        """Shows a text in every window for some seconds."""
        for client in self._server.get_clients().values():
            client.add_notification("drivesplat", text, auto_close_seconds=8.0)

    def click(self, track: str) -> None:
        """Selects the object that was clicked."""
        self.changing(lambda: self.select(track))

    def advance(self, seconds: float) -> None:
        """Plays the drive; at its end it begins again."""
        if self.play.value:
            later = self.view.time + seconds
            self.view.time = later if later <= self.view.session.drive.duration else 0.0
            self.time.value = round(self.view.time, 2)
            self._place_handle()
            self.version += 1

    # ---- what is shown

    def _set_time(self) -> None:
        self.view.time = float(self.time.value)
        self._place_handle()

    def _choose_camera(self) -> None:
        self.view.follow = None if self.follow.value == FREE else self.follow.value

    def _choose_picture(self) -> None:
        self.view.shows, self.view.recorded = self.shows.value, float(self.recorded.value)

    def _choose_methods(self) -> None:
        beside = self.beside.value
        self.view.method = self._names.index(self.method.value)
        self.view.beside = None if beside == SAME else self._names.index(beside)
        self.points.disabled = not self.view.session.drive.renders_lidar
        self.points.value = self.points.value and not self.points.disabled
        self.select(None)

    # ---- edits

    def select(self, track: str | None) -> None:
        """Selects an object to edit, or none."""
        self.selected, self._handle = track, None
        self._server.scene.remove_by_name("/handle")
        if track is None:
            self.message.content = CLICK
            return
        self._handle = self._server.scene.add_transform_controls("/handle", scale=2.5, depth_test=False)
        self._handle.on_update(lambda event: self._drag(event.phase == "end"))
        self._show_change()

    def _show_change(self) -> None:
        """Gives the controls the changes of the vehicle and of the selected object."""
        session = self.view.session
        self.ego_lateral.value, self.ego_speed.value = session.ego_lateral, session.ego_speed
        if self.selected is None:
            return
        change = session.change_of(self.selected)
        self.message.content = describe(session.drive, self.selected)
        self.lateral.value, self.longitudinal.value = change.lateral, change.longitudinal
        self.yaw.value, self.removed.value = change.yaw, change.removed
        self._place_handle()

    def _place_handle(self) -> None:
        """Moves the handle to where the selected object is."""
        if self._handle is not None:
            actors = self.view.drive.state(self.view.time, outside="clamp").actors
            self._handle.visible = self.selected in actors
            if self._handle.visible:
                pose = actors[self._required()].pose
                self._handle.position, self._handle.wxyz = pose[:3, 3], wxyz_of(pose)

    def _required(self) -> str:
        if self.selected is None:
            raise RequestError("click an object first")
        return self.selected

    def _of_all(self, change: Callable[[EditSession], None]) -> None:
        """Makes a change in every method, or in none."""
        before = [(session.changes, session.ego_lateral, session.ego_speed) for session in self.view.sessions]
        try:
            for session in self.view.sessions:
                change(session)
        except DriveSplatError:
            for session, state in zip(self.view.sessions, before, strict=True):
                session.changes, session.ego_lateral, session.ego_speed = state
            raise

    def _change(self, change: Callable[[EditSession, str], None], show: bool = True) -> None:
        """Changes the selected object in every method that has it, and shows the change in the controls."""
        track = self._required()
        self._of_all(lambda session: change(session, track) if track in session.objects else None)
        if show:
            self._show_change()

    def _drag(self, ends: bool) -> None:
        """Remembers that the handle has moved: the next picture places the object. At the end that is done at once."""
        self._dragged = True
        if ends:
            self.changing(lambda: self.place_dragged(show=True))

    def place_dragged(self, show: bool = False) -> None:
        """Places the selected object where its handle was dragged to, if it was."""
        if not self._dragged or self._handle is None:
            return
        self._dragged = False
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(self._handle.wxyz, scalar_first=True).as_matrix()
        pose[:3, 3] = self._handle.position
        self._change(lambda session, track: session.place(track, pose, self.view.time), show)
        self.version += 1

    def _edit_selected(self) -> None:
        fields = {name: float(getattr(self, name).value) for name in ("lateral", "longitudinal", "yaw")}
        self._change(lambda session, track: session.change(track, **fields, removed=bool(self.removed.value)))

    def _paint(self) -> None:
        colour = "#{:02x}{:02x}{:02x}".format(*self.colour.value)
        paint = self.view.paint_of(self._required())
        self._change(lambda session, track: session.change(track, colour=colour, paint=paint))

    def _reset(self) -> None:
        self._change(lambda session, track: session.reset(track))

    def _edit_ego(self) -> None:
        lateral, speed = float(self.ego_lateral.value), float(self.ego_speed.value)
        self._of_all(lambda session: session.change_ego(lateral, speed))

    def _write(self) -> None:
        self.view.session.write(self.edits_file, self.name.value)
        self.say(f"written: edit {self.name.value!r} in {self.edits_file}")
