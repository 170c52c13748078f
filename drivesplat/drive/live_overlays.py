"""What a live viewer draws over its pictures: recorded cameras, the boxes of objects, and LiDAR returns."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from drivesplat.drive.live_view import LiveView, describe, wxyz_of
from drivesplat.drive.pictures import name_colors, with_rest
from drivesplat.drive.world_actor import WorldActor
from drivesplat.scene.tracks import UNIT_CORNERS

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
