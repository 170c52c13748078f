"""The rolling shutters of recorded images: their readout, and the velocity of their camera by the poses around them."""

from collections.abc import Sequence

import numpy as np

from drivesplat.scene.scene import Frame, Scene
from drivesplat.scene.shutter import Shutter, readout_of

APART_US = 40_000, 1_100_000
"""A velocity comes from poses at least and at most so many microseconds before and after the image."""


def shutters(scene: Scene, frames: Sequence[Frame] | None = None) -> list[Shutter | None]:
    """The shutter of each of `frames` (all of the scene's by default); None for a global shutter, and where no two
    images are near enough in time to give a velocity."""
    readouts = {camera.name: readout_of(camera) for camera in scene.cameras}
    rolling = {name: readout for name, readout in readouts.items() if readout.any()}
    if rolling:
        times, first = np.unique([frame.timestamp for frame in scene.frames], return_index=True)
        ego_to_world = np.stack([scene.frames[i].ego_to_world for i in first])
    found: list[Shutter | None] = []
    for frame in scene.frames if frames is None else frames:
        velocity = _velocity(frame, times, ego_to_world) if frame.camera in rolling else None
        if velocity is None:
            found.append(None)
        else:
            found.append(Shutter(np.append(rolling[frame.camera], frame.readout_middle_s), velocity))
    return found


def shutter_of(scene: Scene, frame: Frame) -> Shutter | None:
    """The shutter of one frame; see `shutters`."""
    return shutters(scene, [frame])[0]


def _velocity(frame: Frame, times: np.ndarray, ego_to_world: np.ndarray) -> np.ndarray | None:
    """`Shutter.velocity` (6,): the image's own, or by the ego poses (n, 4, 4) at increasing `times` (n,) in
    microseconds around it; None where there are none."""
    if frame.camera_velocity is not None:
        return frame.camera_velocity
    from scipy.spatial.transform import Rotation  # here: planning imports this module, and scipy takes long

    least, most = APART_US
    before = np.flatnonzero((times <= frame.timestamp - least) & (times >= frame.timestamp - most))
    after = np.flatnonzero((times >= frame.timestamp + least) & (times <= frame.timestamp + most))
    own = int(np.searchsorted(times, frame.timestamp))
    first, last = (before[-1] if len(before) else own), (after[0] if len(after) else own)
    if first == last:
        return None
    seconds = (times[last] - times[first]) * 1e-6
    start, end, ego = ego_to_world[first], ego_to_world[last], frame.ego_to_world
    turning = Rotation.from_matrix(start[:3, :3].T @ end[:3, :3]).as_rotvec() / seconds
    turning = ego[:3, :3] @ turning
    lever = frame.camera_to_world[:3, 3] - ego[:3, 3]
    moving = (end[:3, 3] - start[:3, 3]) / seconds + np.cross(turning, lever)
    to_camera = frame.camera_to_world[:3, :3].T
    return np.concatenate([to_camera @ moving, to_camera @ turning])
