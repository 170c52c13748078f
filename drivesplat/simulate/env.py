"""The closed loop as an environment of Gymnasium (https://gymnasium.farama.org)."""

from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from drivesplat.drive.trained_drive import TrainedDrive, open_drive
from drivesplat.errors import RequestError
from drivesplat.settings.simulate import SimulationSettings
from drivesplat.simulate.simulation import BOX_COLUMNS, EGO_COLUMNS, Observation, Simulation
from drivesplat.simulate.trust import Trust


class DriveEnv(gymnasium.Env[Observation, np.ndarray]):
    """A trained drive as an environment: a policy drives the ego vehicle, and sees what its cameras then show.

    Observations are those of `Simulation.observation`, `info` that of `Simulation.facts`. The reward is the progress in
    metres along the recorded path. An episode terminates at a contact with an object or too far from the path, by the
    settings, and is truncated at the end of its time.

    The same seed and actions give the same states, on a CPU also the same images.

    >>> env = DriveEnv("results/demo/street", cameras=("CAM_FRONT",), width=400)
    >>> observation, info = env.reset(seed=0)
    >>> observation, reward, terminated, truncated, info = env.step(np.array([0.0, 1.0]))
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(
        self,
        drive: TrainedDrive | str | Path,
        edits: list[dict[str, Any]] | None = None,
        render_mode: str | None = None,
        device: str = "any",
        trust: Trust | None = None,
        **settings: Any,
    ):
        """
        Args:
            drive: A drive, or the result folder of a method.
            edits: Steps of an edit, as in an edits file.
            render_mode: 'rgb_array': `render` gives the image of the first camera.
            device: 'any', 'cuda' or 'cpu', for a drive that is opened here.
            trust: With `validity`, that of the same drive and edits, to be shared with other environments; None: made
                here.
            settings: Those of `SimulationSettings`, such as `rate_hz=20` or `traffic={"vehicles": "replay"}`.

        Raises RequestError and ConfigError for what does not fit the drive.
        """
        opened = drive if isinstance(drive, TrainedDrive) else open_drive(drive, device)
        self.simulation = Simulation(
            opened if not edits else opened.edited(edits), SimulationSettings.model_validate(settings)
        )
        (Trust(self.simulation.drive) if trust is None else trust).inform(self.simulation)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise RequestError(f"there is no render mode {render_mode!r}; there is: rgb_array")
        self.render_mode, self.settings = render_mode, self.simulation.settings
        self.metadata = {**self.metadata, "render_fps": self.settings.rate_hz}
        self.action_space = self._actions()
        self.observation_space = self._observations()
        self._over = True
        self._seen: Observation = {}

    def _actions(self) -> spaces.Box:
        limits = self.settings.vehicle
        if self.settings.actions == "poses":
            far = np.tile([1000.0, 1000.0, np.pi], (self.settings.horizon, 1)).astype(np.float32)
            return spaces.Box(-far, far, dtype=np.float32)
        low, high = (-limits.max_steering, -limits.max_braking), (limits.max_steering, limits.max_acceleration)
        return spaces.Box(np.array(low, dtype=np.float32), np.array(high, dtype=np.float32), dtype=np.float32)

    def _observations(self) -> spaces.Dict:
        def floats(*shape: int, low: float = -np.inf) -> spaces.Box:
            return spaces.Box(low, np.inf, shape, np.float32)

        made: dict[str, spaces.Space[Any]] = {
            "ego": floats(len(EGO_COLUMNS)),
            "route": floats(self.settings.route_points, 3),
            "boxes": floats(self.settings.max_boxes, len(BOX_COLUMNS)),
        }
        cameras = {}
        for name, camera in self.simulation.cameras.items():
            size = camera.height, camera.width
            known = {
                "rgb": spaces.Box(0, 255, (*size, 3), np.uint8),
                "depth": floats(*size, low=0.0),
                "instance": spaces.Box(-1, np.iinfo(np.int16).max, size, np.int16),
            }
            cameras[name] = spaces.Dict({output: known[output] for output in self.settings.outputs})
        if cameras:
            made["cameras"] = spaces.Dict(cameras)
        if self.simulation.lidar is not None:
            rays = self.simulation.lidar.rays.shape
            made["lidar"] = spaces.Dict({"range": floats(*rays, low=0.0), "intensity": floats(*rays, low=0.0)})
        return spaces.Dict(made)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begins an episode. `seed` draws what the settings vary (None: the next one of this environment)."""
        super().reset(seed=seed)
        own = int(self.np_random.integers(2**31)) if seed is None else seed
        self.simulation.reset(own)
        self._over = False
        return self._observed(), self.simulation.facts()

    def step(self, action: np.ndarray) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Moves on by a step. Raises RequestError for an action that is not finite or has another shape, and after the
        end of an episode."""
        if self._over:
            raise RequestError("the episode is over: reset() begins another one")
        before = self.simulation.progress
        self.simulation.step(action)
        terminated, truncated = self.simulation.outcome is not None, self.simulation.ended
        self._over, reward = terminated or truncated, self.simulation.progress - before
        return self._observed(), reward, terminated, truncated, self.simulation.facts()

    def render(self) -> np.ndarray | None:
        """The last image of the first camera, if `render_mode` is 'rgb_array'."""
        if self.render_mode is None or not self._seen:
            return None
        if "cameras" not in self._seen or "rgb" not in self.settings.outputs:
            raise RequestError("the environment has no image: give it a camera, and 'rgb' among `outputs`")
        return next(iter(self._seen["cameras"].values()))["rgb"].copy()

    def _observed(self) -> Observation:
        self._seen = self.simulation.observation()
        return self._seen


def vector_env(
    drive: TrainedDrive | str | Path,
    count: int,
    edits: list[dict[str, Any]] | None = None,
    device: str = "any",
    **settings: Any,
) -> SyncVectorEnv:
    """So many environments of one drive, whose model, and what tells its validity, is in memory once. Episodes begin
    anew at the step after their end.

    >>> envs = vector_env("results/demo/street", 4, cameras=("CAM_FRONT",), width=200)
    """
    opened = drive if isinstance(drive, TrainedDrive) else open_drive(drive, device)
    changed = opened if not edits else opened.edited(edits)
    trust = Trust(changed)
    return SyncVectorEnv(
        [lambda: DriveEnv(changed, trust=trust, **settings)] * count, autoreset_mode=AutoresetMode.NEXT_STEP
    )
