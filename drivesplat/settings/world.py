"""Settings of synthetic worlds."""

from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal, get_args

from pydantic import Field, model_serializer, model_validator

from drivesplat.settings import Settings
from drivesplat.settings.edit import Edit

CameraChannel = Literal[
    "CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_FRONT_LEFT"
]  # fmt: skip

Gain = Annotated[float, Field(gt=0, le=8)]


Channel = CameraChannel | Literal["LIDAR_TOP"]
WalkwayPlace = Literal["road", "sidewalk"]
Offset = Annotated[float, Field(ge=-6, le=6)]
NOT_WITH_A_ROUTE = ("bystanders", "dogs", "traffic", "ego", "bend_deg", "grade")
"""Settings of the one street."""
MAX_STREET_KEY_FRAMES = 400
"""Maximum number of key frames without a route."""


class WorldLidarSettings(Settings):
    """The LiDAR of a synthetic world."""

    beams: Literal[32, 64] = 32
    """32: the HDL-32E of nuScenes; 64: the HDL-64E of KITTI."""
    spins: bool = False
    """Each ray leaves at its own time of the revolution, which ends at the sweep's timestamp. false = all at the
    timestamp."""
    divergence_mrad: float = Field(0.0, ge=0, le=10)
    """Full angle of a beam in milliradians (HDL-32E: 3). A beam that grazes an edge returns the stronger of its echoes.
    0 = a line."""
    ego_returns: bool = False
    """Beams also hit the ego vehicle."""


class WorldTruthSettings(Settings):
    """The ground truth of a synthetic world, written below truth/."""

    cameras: tuple[CameraChannel, ...] = ("CAM_FRONT",)
    """Cameras with truth at key frames. A camera that is not among those that record is a held-out camera."""
    lateral_m: tuple[Offset, ...] = (2.0, -2.0, 4.0)
    """Offsets of the lateral views to the left of the recorded one, in metres."""
    lidar: bool = False
    """Write the scans of key frames, ray by ray: range without noise, intensity, instance, and whether it returned."""
    edits: tuple[str, ...] | None = ()
    """Names of edits in the scene's edits file whose truth is written. null = all. docs/editing.md"""


class WorldRouteSettings(Settings):
    """A route through a grid of streets, for drives of any length. docs/world.md"""

    block_m: float = Field(84.0, ge=70, le=200)
    """Distance of neighbouring crossings in metres."""
    speed: float = Field(12.0, ge=3, le=20)
    """Speed of the ego vehicle on straight streets in m/s. It slows down for turns."""
    loop_blocks: int = Field(12, ge=4, le=200, multiple_of=2)
    """Number of blocks from a street until the route passes the same street again. Loops of 8 blocks and more have
    turns to both sides."""
    closure: Literal["same", "opposite"] = "same"
    """Direction in which the route passes the street again."""


class WorldSettings(Settings):
    """A synthetic street in nuScenes format, generated at the dataset's dataroot, with ground truth that recorded
    drives lack. docs/world.md"""

    random_seed: int = Field(0, ge=0, lt=2**31)
    """Random seed of placement and colours."""
    width: int = Field(400, ge=64, le=1600)
    """Width of all images in pixels (nuScenes: 1600). The height is 9/16 of it."""
    samples_per_pixel: int = Field(4, ge=1, le=64)
    """Rays per pixel, evenly spread. By day each has a shadow ray."""
    cameras: tuple[CameraChannel, ...] | None = None
    """Cameras that record. null = those of the setting `cameras`."""
    key_frames: int = Field(20, ge=2, le=100_000)
    """Number of key frames: with a route any number, else at most 400."""
    key_frame_hz: Literal[2, 10] = 2
    """Key frames a second: 2 as nuScenes, 10 as Waymo and KITTI."""
    image_hz: Literal[10, 12, 20] = 12
    """Images a second of cameras in `sweeps`; a multiple of key_frame_hz."""
    lidar_hz: Literal[10, 20] = 20
    """Revolutions of the LiDAR a second."""
    sweeps: tuple[Channel, ...] | None = None
    """Sensors that also record between key frames. null = those that are used there: the cameras of the setting
    `cameras` if `sweeps` is true, LIDAR_TOP if `lidar_seed.sweeps` is true."""
    readout_s: float = Field(0.0, ge=0, le=0.1)
    """Seconds from the first row of an image to the last (rolling shutter, downwards). Timestamps are those of the
    middle row. 0 = all rows at once."""
    vehicles: int = Field(2, ge=0, le=6)
    """Number of moving vehicles. The first drives ahead of the ego vehicle; the others are oncoming or further ahead.
    """
    pedestrians: int = Field(10, ge=0, le=24)
    """Number of walking pedestrians, who come into view of the front camera one after the other."""
    walkways: tuple[WalkwayPlace, ...] = Field(("road", "sidewalk"), min_length=1)
    """Where pedestrians walk: on the road beside parked vehicles, on the sidewalk."""
    bystanders: int = Field(0, ge=0, le=12)
    """Number of people who stand and turn."""
    cyclists: int = Field(0, ge=0, le=4)
    """Number of cyclists."""
    dogs: int = Field(0, ge=0, le=4)
    """Number of dogs, each beside a pedestrian."""
    parked: int = Field(9, ge=0, le=16)
    """Number of parked vehicles."""
    traffic: Literal["free", "queue"] = "free"
    """'queue': the ego vehicle creeps in a queue at close range, in place of `vehicles`."""
    ego: Literal["drives", "stands"] = "drives"
    """Motion of the ego vehicle."""
    bend_deg: float = Field(0.0, ge=-60, le=60)
    """Angle of a bend of the road to the left."""
    grade: float = Field(0.0, ge=-0.12, le=0.12)
    """Slope of the road ahead: metres of height per metre."""
    route: WorldRouteSettings | None = None
    """A drive through a grid of streets, without ground truth. Numbers of vehicles, pedestrians and cyclists then
    count for ten seconds of the drive, that of parked vehicles for 130 metres of street. null = a drive along one
    street."""
    own_car: bool = False
    """Show the rear of the ego vehicle at the lower edge of CAM_BACK's images."""
    exposures: dict[Channel, tuple[Gain, Gain, Gain]] = Field(default_factory=dict)
    """Gains of the red, green and blue channels before gamma encoding, by camera: {CAM_BACK: [1.3, 1.2, 1.0]}. Other
    cameras have 1. They imitate cameras with independent exposure and white balance."""
    night: bool = False
    """Street lamps, headlights and sensor noise instead of the sun."""
    wet: bool = False
    """A wet road, which mirrors the sky and returns little to the LiDAR."""
    pose_noise: bool = False
    """Give ego poses the errors of nuScenes: z = 0, roll and pitch off by half a degree, positions by centimetres."""
    class_maps: bool = False
    """Write class and sky maps of all images to semantic/ and sky/ below dataroot, for masks.semantic_folder and
    masks.sky_folder."""
    lidar: WorldLidarSettings = Field(default_factory=WorldLidarSettings)
    truth: WorldTruthSettings = Field(default_factory=WorldTruthSettings)

    @model_validator(mode="after")
    def _rates_are_multiples(self) -> "WorldSettings":
        if self.image_hz % self.key_frame_hz:
            raise ValueError(f"image_hz is {self.image_hz}, no multiple of key_frame_hz ({self.key_frame_hz})")
        return self

    @model_validator(mode="after")
    def _fit_the_route(self) -> "WorldSettings":
        if self.route is None:
            if self.key_frames > MAX_STREET_KEY_FRAMES:
                raise ValueError(
                    f"key_frames is {self.key_frames}: one street has at most {MAX_STREET_KEY_FRAMES}; set route for a "
                    "longer drive"
                )
            return self
        fields = type(self).model_fields
        unfit = [name for name in NOT_WITH_A_ROUTE if getattr(self, name) != fields[name].get_default()]
        if unfit:
            what = "it" if len(unfit) == 1 else "them"
            raise ValueError(f"a world with a route has no {', '.join(unfit)}; leave {what} out")
        if self.truth != WorldTruthSettings():
            raise ValueError("a world with a route has no ground truth; leave out truth")
        return self

    @model_serializer(mode="wrap")
    def _without_a_null_route(self, dump: Callable[[Any], dict[str, Any]]) -> dict[str, Any]:
        """Worlds without a route keep the settings, and so the digests, that they had before there were routes."""
        return {name: value for name, value in dump(self).items() if name != "route" or value is not None}

    def with_sensors(self, cameras: Sequence[str], sweeps: bool, lidar_sweeps: bool) -> "WorldSettings":
        """These settings with the names of sensors in place of null, for a config that uses `cameras`.

        These cameras record. Between key frames they record if the config uses these images (`sweeps`), and the LiDAR
        if it uses these scans (`lidar_sweeps`). A rig has no cameras of other names.

        >>> made = WorldSettings().with_sensors(["CAM_FRONT"], sweeps=False, lidar_sweeps=True)
        >>> made.cameras, made.sweeps
        (('CAM_FRONT',), ('LIDAR_TOP',))
        """
        recording = tuple(cameras) if self.cameras is None else self.cameras
        of_rig = [channel for channel in get_args(CameraChannel) if channel in recording and channel in cameras]
        used = (*(of_rig if sweeps else ()), *(("LIDAR_TOP",) if lidar_sweeps else ()))
        between = used if self.sweeps is None else self.sweeps
        return self.model_copy(update={"cameras": recording, "sweeps": between})

    @property
    def seconds(self) -> float:
        """Duration of the drive."""
        return (self.key_frames - 1) / self.key_frame_hz


class WorldDonor(Settings):
    """An object of a synthetic world: that of the drive `scene` whose track begins with `track`."""

    scene: str
    track: str
    world: WorldSettings


class WorldJob(Settings):
    """Settings of the rule `demo_world`: name of the scene, name of the folder of tables, the street, the edits
    whose truth is written, and the objects that they insert, by the names of their assets."""

    scene: str
    version: str
    world: WorldSettings
    edits: dict[str, Edit] = Field(default_factory=dict)
    donors: dict[str, WorldDonor] = Field(default_factory=dict)
