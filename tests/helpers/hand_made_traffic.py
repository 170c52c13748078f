"""A part of two vehicles that drive, turn and are absent at times; where they are at a time is known in closed form."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import nn

from drivesplat.model.gaussians import Gaussians, concatenate
from drivesplat.model.harmonics import rotated
from drivesplat.model.part import Part, RigidGroup
from drivesplat.model.states import IMAGE, State, Want
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Scene
from drivesplat.trajectories.motion import Motion

TURNING, GONE_AT_TIMES = "0a8dee9e8b4b4b0f8d6c2a5f1e3d4c5b", "f00dee9e8b4b4b0f8d6c2a5f1e3d4c5b"
REACH = 0.25
FADING = 0.03
"""How much the first coefficient of colours grows in a second."""


@dataclass(frozen=True)
class Trajectory:
    """Steadily ahead from `start` at `velocity` (m/s), turning at `rate` (rad/s), tilted a little; annotated at `times`
    seconds in `runs`."""

    start: tuple[float, float, float]
    velocity: tuple[float, float, float]
    rate: float
    times: tuple[float, ...]
    runs: tuple[tuple[int, int], ...]

    def pose(self, seconds: float) -> np.ndarray:
        """Object to world (4, 4): what a spline through such poses gives, as it is linear."""
        turned = Rotation.from_euler("z", 0.3 + self.rate * seconds) * Rotation.from_euler("y", 0.05)
        return rigid(turned.as_matrix(), np.array(self.start) + seconds * np.array(self.velocity))

    def is_there(self, seconds: float) -> bool:
        return any(self.times[a] - REACH <= seconds <= self.times[b] + REACH for a, b in self.runs)

    @property
    def motion(self) -> Motion:
        return Motion(np.array(self.times), np.stack([self.pose(t) for t in self.times]), self.runs, REACH)


def key_times(first: int, last: int) -> tuple[float, ...]:
    """Times of the tiny drive's key frames: 35 ms after their images."""
    return tuple(0.035 + 0.5 * k for k in range(first, last + 1))


TRAJECTORIES = {
    TURNING: Trajectory((10.0, 2.0, 0.8), (4.0, -1.0, 0.0), 0.8, key_times(0, 5), ((0, 5),)),
    GONE_AT_TIMES: Trajectory(
        (-5.0, -3.0, 1.0), (9.0, 3.0, 0.1), -0.5, key_times(1, 2) + key_times(5, 8), ((0, 1), (2, 5))
    ),
}
"""On the tiny drive, whose middle image is at 2.25 s: the second is absent then."""


def some_gaussians(count: int, sh_degree: int, seed: int) -> Gaussians:
    """Gaussians within two metres of the origin."""
    generator = torch.Generator().manual_seed(seed)
    random = torch.rand(count, 8, generator=generator)
    quats = torch.randn(count, 4, generator=generator)
    sh = 0.3 * torch.randn(count, (sh_degree + 1) ** 2, 3, generator=generator)
    return Gaussians.of(4.0 * random[:, :3] - 2.0, quats, 0.01 + random[:, 3:6], 0.01 + 0.98 * random[:, 6], sh)


def own_gaussians(track_id: str, time: float) -> Gaussians:
    """A vehicle's in its own frame, in the colours of a time."""
    own = some_gaussians(12, 1, seed=list(TRAJECTORIES).index(track_id))
    return replace(own, sh0=own.sh0 + FADING * time)


def placed(own: Gaussians, pose: np.ndarray) -> Gaussians:
    """Gaussians of an object's frame in the world, object to world being `pose` (4, 4); computed in float64."""
    means = own.means.double().numpy() @ pose[:3, :3].T + pose[:3, 3]
    turned = Rotation.from_matrix(pose[:3, :3]) * Rotation.from_quat(own.quats.double().numpy(), scalar_first=True)
    quats, rotation = turned.as_quat(scalar_first=True), torch.from_numpy(pose[:3, :3].copy())
    sh = rotated(own.sh.double(), rotation).float()
    return replace(
        own, means=torch.from_numpy(means).float(), quats=torch.from_numpy(quats).float(), sh0=sh[:, :1], shN=sh[:, 1:]
    )


class Traffic(Part):
    """The vehicles of `COURSES`."""

    name = "traffic"
    moves = True

    def __init__(self) -> None:
        super().__init__()
        all_gaussians = concatenate([own_gaussians(track_id, 0.0) for track_id in TRAJECTORIES])
        self.params = nn.ParameterDict({"means": all_gaussians.means})

    def state(self, time: float, want: Want = IMAGE) -> State:
        return State((torch.tensor(time, dtype=torch.float64),))

    def sample(self, state: State, want: Want = IMAGE) -> Gaussians:
        shown, time = [], float(state.now[0])
        for track_id, trajectory in TRAJECTORIES.items():
            gaussians = placed(own_gaussians(track_id, time), trajectory.pose(time))
            shown.append(replace(gaussians, opacities=gaussians.opacities * trajectory.is_there(time)))
        return concatenate(shown)

    def rigid_groups(self, time: float) -> dict[str, RigidGroup]:
        return {
            track_id: RigidGroup(own_gaussians(track_id, time), trajectory.motion)
            for track_id, trajectory in TRAJECTORIES.items()
        }

    def learning_rates(self) -> dict[str, float]:
        return {}


def with_turning_track(scene: Scene) -> Scene:
    """The scene with a track, a car of 4 x 2 x 1.6 m, of the turning vehicle's id; of the other it knows nothing."""
    car = next(track for track in scene.tracks if track.category == "vehicle.car")
    return replace(scene, tracks=(*scene.tracks, replace(car, id=TURNING)))
