"""Settings of runs in the closed loop."""

from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from drivesplat.settings import Settings
from drivesplat.settings.edit import Edit

Length = Annotated[float, Field(gt=0, le=40)]
Seconds = Annotated[float, Field(ge=0, le=36000)]


class VehicleBody(Settings):
    """The box of the ego vehicle. Its origin is on the ground below the rear axle."""

    length: Length = 4.6
    """Metres."""
    width: Length = 1.9
    """Metres."""
    height: Length = 1.6
    """Metres."""
    rear_overhang: float = Field(0.9, ge=0, le=20)
    """Metres of the body behind the rear axle."""


class VehicleSettings(VehicleBody):
    """The ego vehicle. Its origin is on the ground below the rear axle."""

    wheelbase: Length = 2.8
    """Metres between the axles."""
    max_steering: float = Field(0.6, gt=0, le=1.2)
    """The largest angle of the front wheels, radians."""
    max_steering_rate: float = Field(1.0, gt=0, le=20)
    """The largest change of that angle, radians a second."""
    max_acceleration: float = Field(3.0, gt=0, le=20)
    """m/s²."""
    max_braking: float = Field(8.0, gt=0, le=20)
    """m/s²."""
    max_speed: float = Field(40.0, gt=0, le=100)
    """m/s."""
    max_reverse_speed: float = Field(0.0, ge=0, le=50)
    """The largest speed backwards, m/s. 0: a vehicle that brakes stays where it comes to rest."""


class TrafficSettings(Settings):
    """The other objects."""

    vehicles: Literal["replay", "react"] = "react"
    """'replay': as recorded or edited. 'react': the same until one would come too close to what is ahead of it on its
    path; from then on it follows this path by the intelligent driver model."""
    people: Literal["go_on", "stop"] = "go_on"
    """'stop': people wait while the ego vehicle is about to come close to them."""
    time_gap: float = Field(1.5, gt=0, le=10)
    """Seconds that a driver keeps to the vehicle ahead."""
    standstill_gap: float = Field(2.0, gt=0, le=20)
    """Metres that a standing driver keeps."""
    acceleration: float = Field(1.5, gt=0, le=10)
    """The largest acceleration of a driver, m/s²."""
    braking: float = Field(2.0, gt=0, le=10)
    """The comfortable deceleration of a driver, m/s²."""
    variation: float = Field(0.0, ge=0, le=0.5)
    """Standard deviation of drivers' time gaps and accelerations, relative, drawn by the seed."""


class SimulationSettings(Settings):
    """A run in the closed loop. docs/closed_loop.md"""

    rate_hz: float = Field(10.0, gt=0, le=100)
    """Steps a second."""
    start: Seconds = 0.0
    """The second of the recording at which a run begins."""
    seconds: Seconds | None = None
    """The length of a run. null = to the end of the recording."""
    recorded_until: Seconds = 0.0
    """Seconds after the start up to which the ego vehicle follows the recorded path, whatever the policy does."""
    beyond: Literal["end", "go_on"] = "end"
    """What happens at the end of the recording: the run ends, or goes on in the street as it was last seen, without the
    objects whose recording has ended."""
    actions: Literal["control", "poses"] = "control"
    """What a policy gives: 'control', the angle of the front wheels (radians) and the acceleration (m/s²); 'poses', x,
    y and heading of the next `horizon` steps in the frame of the vehicle."""
    horizon: int = Field(10, ge=1, le=200)
    """Steps of an action of 'poses'."""
    end_on_collision: bool = True
    """Whether a run ends when the ego vehicle touches an object."""
    max_offset: float | None = Field(None, gt=0)
    """Metres from the recorded path at which a run ends. null = never."""
    cameras: tuple[str, ...] | None = None
    """The cameras that a policy sees. null = the first one; () = none."""
    width: int | None = Field(None, ge=16, le=8192)
    """The width of their images in pixels. null = as recorded."""
    rolling_shutter: bool = False
    """Whether these images have the rolling shutter of the recorded camera, where it is known."""
    outputs: tuple[Literal["rgb", "depth", "instance"], ...] = ("rgb",)
    """What a policy sees of a camera."""
    validity: bool = False
    """Whether a policy sees how far the image of the first camera and the scan can be trusted. An image takes about
    30 ms a step."""
    lidar: str | None = None
    """The LiDAR that a policy sees. null = none."""
    max_boxes: int = Field(32, ge=1, le=1000)
    """The largest number of objects in an observation, the nearest ones."""
    route_points: int = Field(20, ge=1, le=500)
    """The number of points of the recorded path ahead."""
    route_step: float = Field(2.0, gt=0, le=50)
    """Metres between them."""
    vehicle: VehicleSettings = Field(default_factory=VehicleSettings)
    traffic: TrafficSettings = Field(default_factory=TrafficSettings)

    @model_validator(mode="after")
    def _has_something_to_judge(self) -> "SimulationSettings":
        if self.validity and self.cameras == () and self.lidar is None:
            raise ValueError("'validity' is that of an image or a scan: name a camera in 'cameras', or a 'lidar'")
        return self

    @field_validator("cameras", "outputs")
    @classmethod
    def _once(cls, values: tuple[str, ...] | None) -> tuple[str, ...] | None:
        if values is not None and len(set(values)) < len(values):
            raise ValueError("a name stands twice")
        return values


class RunSettings(Settings):
    """A run of a runs file: who drives where."""

    policy: str = Field(min_length=1)
    """'recorded', 'constant_speed' or 'pure_pursuit'; or an entry point, `my_package.my_module:MyPolicy`, of a module
    beside the Snakefile or of an installed package."""
    policy_settings: dict[str, Any] = Field(default_factory=dict)
    """What the policy is made with."""
    scenes: tuple[str, ...] | None = None
    """The scenes to drive in. null = all of the batch, with an edit those that have it."""
    methods: tuple[str, ...] = Field(("street",), min_length=1)
    """The methods whose models are driven in."""
    edit: str | None = None
    """The name of an edit in each scene's edits file. null = as recorded."""
    seeds: tuple[Annotated[int, Field(ge=0, lt=2**31)], ...] = Field((0,), min_length=1)
    """The seeds of the episodes."""
    timeout_s: float = Field(60.0, gt=0)
    """Seconds that a policy may take for an action."""
    film_width: int = Field(640, ge=64, le=3840)
    """The width in pixels of the camera's image in the film."""
    simulation: SimulationSettings = Field(default_factory=SimulationSettings)


class RunJob(Settings):
    """All settings that determine a run; `edit` has the steps, `code` is a digest of the policy's module."""

    run: RunSettings
    edit: Edit | None
    code: str | None
    crf: int
