"""Settings of the rule `train`."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator

from drivesplat.settings import Settings
from drivesplat.settings.drifting import DriftingSettings
from drivesplat.settings.train_objects import ActorSettings, DeformableSettings

PartName = Literal["background", "road", "actors", "deformable", "drifting"]
STAGE_OF_PART: dict[PartName, str] = {"actors": "actors", "deformable": "actors"}
"""The parts whose Gaussians are objects that move, and the stage that finds these objects in a scene."""
MOVING_PARTS: tuple[PartName, ...] = (*STAGE_OF_PART, "drifting")
"""The parts whose Gaussians are dynamic, objects or not. The settings of such a part are the field of TrainSettings
with its name."""
SkyKind = Literal["none", "mask", "cubemap"]
Milliradians = Annotated[float, Field(ge=0, le=20)]


class FloaterSettings(Settings):
    radius: float = Field(1.0, ge=0, le=10)
    """Distance from the path of the training cameras (metres) within which Gaussians are faded out: the ego vehicle
    drove there, so the space is empty. 0 = off."""
    below_road: bool = False
    """Also fade out Gaussians whose centres lie `train.road.reach` to 5 m below the road. Needs `train.road_weight`
    above 0. Leave this off on wet roads, which mirror what is above them."""
    every: int = Field(100, ge=1)
    """Iterations between these steps."""


class RoadSettings(Settings):
    """The surface of the road: for the part `road`, whose Gaussians lie in it, and without this part for the background
    Gaussians that train.road_weight acts on (docs/geometry.md)."""

    surface: Literal["path", "lidar", "lidar_or_path"] = "path"
    """'path': the road under the path of the vehicle, which follows from its poses. 'lidar': the ground wherever LiDAR
    seed points show it. 'lidar_or_path': the latter, and where LiDAR gives no plane of the ground, the former."""
    half_width: float = Field(1.2, gt=0, le=10)
    """Maximum lateral distance from the path of the vehicle's centre (metres) of the road under the path. The weight
    falls with this distance, since kerbs and grass may begin beside the vehicle."""
    reach: float = Field(0.3, gt=0, le=2)
    """Maximum height of a centre above or below the road surface (metres). The part `road` has a layer of its own."""


class ScanTrainingSettings(Settings):
    """Rendered LiDAR: Gaussians with an intensity and a probability to return a ray, fitted to recorded scans. Needs
    strategy: mcmc. Defaults of the weights are those of SplatAD (Hess et al. 2025, arXiv 2411.16816)."""

    per_image: float = Field(0.0, ge=0, le=10)
    """Iterations that fit a scan, per iteration that fits an image, in addition to these and evenly spread among them.
    0 = LiDAR is not rendered. Without cameras each of `train.iterations` fits a scan where it is above 0."""
    geometry: float = Field(1.0, ge=0, le=1)
    """Factor of the gradient by which scans move and shape Gaussians. 0 = they fit intensities and returns alone, and
    images are rendered as without LiDAR."""
    fine_tune: float = Field(0.0, ge=0, le=10)
    """Further iterations that fit scans and change no image, per iteration that fits an image: they fit offsets of
    position, rotation, size and opacity of background Gaussians that only the LiDAR sees, intensities and returns.
    Densification and all schedules of images end before them. 0 = no such offsets."""
    range_weight: float = Field(0.1, ge=0)
    """Loss weight of the mean absolute error of ranges (metres), without the worst 5 % of the rays."""
    intensity_weight: float = Field(1.0, ge=0)
    """Loss weight of the mean squared error of intensities, in [0, 1]."""
    drop_weight: float = Field(0.1, ge=0)
    """Loss weight of the binary cross entropy between the probability of a return and whether there is one."""
    sight_weight: float = Field(0.1, ge=0)
    """Loss weight of the mean alpha of what is nearer than a return by `sight_margin`: a ray that returns has passed
    empty space."""
    sight_margin: float = Field(0.8, ge=0, le=10)
    """Distance before a return (metres) that need not be empty."""
    points: int = Field(100_000, ge=0, le=5_000_000)
    """Maximum number of seed points from training scans, where no camera saw a surface: a LiDAR looks all around. The
    limits on the number of Gaussians rise by their number. 0 = none."""
    beam_spread: tuple[Milliradians, Milliradians] = (0.3, 0.3)
    """Standard deviation of a beam's footprint in azimuth and elevation (milliradians)."""

    @property
    def beam_spread_rad(self) -> tuple[float, float]:
        """`beam_spread` in radians."""
        azimuth, elevation = self.beam_spread
        return 1e-3 * azimuth, 1e-3 * elevation


class ExposureSettings(Settings):
    """Exposure of each camera. Cameras of one rig set exposure and white balance independently, which causes seams
    where their images overlap, and change them while the vehicle drives."""

    kind: Literal["none", "affine"] = "affine"
    """'affine': a gain and an offset per colour channel for every camera but eval_camera, which is the reference. They
    are initialised from surfaces that several cameras recorded, then learned; and gains over time of every camera
    (`interval`)."""
    interval: float | None = Field(1.0, ge=0.1, le=60)
    """Seconds between the times at which gains of every camera, eval_camera included, are learned; linear in between
    and constant beyond the last training image. Where an exposure changes fast, found before training, these are the
    times of images. null: constant exposures."""
    sigma_gain: float = Field(0.1, gt=0)
    """Expected deviation of a camera's gains from their initial values (natural logarithm)."""
    sigma_offset: float = Field(0.02, gt=0)
    """Expected deviation of a camera's offsets from 0 (1 = full scale)."""
    weight: float = Field(0.002, ge=0)
    """Loss weight of the mean square of log gains and offsets, in units of these deviations."""
    start: float = Field(0.1, ge=0, le=1)
    """Fraction of the iterations after which exposures are learned."""
    learning_rate: float = Field(1e-2, gt=0)
    """Learning rate of log gains and offsets, in the same units. Decays exponentially to a hundredth."""


def _complete(parts: tuple[PartName, ...]) -> tuple[PartName, ...]:
    """Refuses a list without the background, which every scene has, and a list that names a part twice."""
    if "background" not in parts:
        raise ValueError("it lacks 'background', the only part that every scene has: add it")
    if len(set(parts)) != len(parts):
        raise ValueError("it names a part twice")
    return parts


Parts = Annotated[
    tuple[PartName, ...],
    AfterValidator(_complete),
    Field(json_schema_extra={"contains": {"const": "background"}, "uniqueItems": True}),
]
"""Parts of a model."""


class GaussianSettings(Settings):
    """Initial values and learning rates of Gaussians. Learning rates are those of gsplat's example trainer, those of
    scales and rotations twice as high (docs/tried.md)."""

    sh_degree: int = Field(1, ge=0, le=3)
    """Degree of the spherical harmonics of the colours. A drive shows objects from few directions; degree 3 gives the
    same held-out PSNR with twice the memory (docs/tried.md)."""
    init_opacity: float = Field(0.1, gt=0, lt=1)
    """Initial opacity of seed Gaussians."""
    init_scale: float = Field(0.4, gt=0, le=10)
    """Initial scale of a seed Gaussian, in units of the root mean square distance to its three nearest neighbours.
    Small and faint seeds give higher PSNR where LiDAR is dense."""
    lr_means: float = Field(1.6e-4, gt=0)
    """Learning rate of positions, in units of the scene scale. Decays exponentially to a hundredth."""
    lr_scales: float = Field(1e-2, gt=0)
    """Learning rate of log scales."""
    lr_quats: float = Field(2e-3, gt=0)
    """Learning rate of rotations."""
    lr_opacities: float = Field(5e-2, gt=0)
    """Learning rate of opacity logits."""
    lr_sh0: float = Field(2.5e-3, gt=0)
    """Learning rate of the colours' constant term."""
    lr_classes: float = Field(1e-2, gt=0)
    """Learning rate of class logits, where class maps are given (masks.semantic_folder)."""
    lr_lidar_logits: float = Field(1e-2, gt=0)
    """Learning rate of LiDAR's logits of intensity and return, where LiDAR is rendered (train.scans)."""
    lr_shN: float = Field(1.25e-4, gt=0)
    """Learning rate of the colours' view-dependent terms."""


class McmcSettings(Settings):
    """strategy: mcmc. 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024), gsplat's
    MCMCStrategy."""

    noise_lr: float = Field(5e5, ge=0)
    """Strength of the exploration noise on positions."""
    min_opacity: float = Field(0.005, gt=0, lt=1)
    """Opacity below which Gaussians are relocated."""
    refine_every: int = Field(100, ge=1)
    """Iterations between densification steps (relocation and growth)."""


class DefaultSettings(Settings):
    """strategy: default. Densification by screen-space gradient (Kerbl et al. 2023), gsplat's DefaultStrategy."""

    grow_grad2d: float = Field(2e-4, gt=0)
    """Mean screen-space gradient above which Gaussians are split or duplicated."""
    prune_opacity: float = Field(0.005, gt=0, lt=1)
    """Opacity below which Gaussians are removed."""
    refine_every: int = Field(100, ge=1)
    """Iterations between densifications."""
    reset_every: int = Field(3000, ge=1)
    """Iterations between resets of all opacities."""


class CoarseToFineSettings(Settings):
    """Trains with reduced images and fewer Gaussians at first, so that early iterations are faster (after DashGaussian,
    Chen et al. 2025, arXiv 2503.18402)."""

    quarter_until: float = Field(0.2, ge=0, le=1)
    """Fraction of the iterations that use images of a quarter of the width and height."""
    half_until: float = Field(0.7, ge=0, le=1)
    """Fraction of the iterations after which images have full size. Before it they have half the width and height."""
    min_height: int = Field(225, ge=16)
    """Minimum number of rows of a reduced image. 900 rows are reduced to 225; images of 640x360 are not reduced."""
    fraction: float = Field(0.6, gt=0, le=1)
    """Fraction of the Gaussian limit that applies while images are reduced, with strategy: mcmc. The full limit
    applies early enough for the number of Gaussians to reach it before densification stops."""


class TrainSettings(Settings):
    iterations: int = Field(7_000, ge=1, le=1_000_000)
    """:printed: Number of optimisation steps that fit an image each; methods that render LiDAR have further ones for
    scans (`scans`)."""
    strategy: Literal["mcmc", "default"] = "mcmc"
    """:printed: Densification: 'mcmc', or 'default' (by gradient), which fills the space in front of sparse cameras."""
    cap_max: int = Field(1_500_000, ge=100, le=20_000_000)
    """:printed: Maximum number of Gaussians of the background. Those of objects come on top (`actors.cap_max` and
    `deformable.cap_max`). GPU memory: about 0.4 GB per million, and as much again while rendering."""
    pixels_per_gaussian: float = Field(20.0, ge=0)
    """Minimum number of training pixels per Gaussian (0 disables the limit). More Gaussians overfit single views."""
    max_distance: float | None = Field(1000.0, gt=0)
    """Maximum distance of Gaussians from the world's origin (metres). Where a camera is farther than half of it from
    the origin, half of it beyond the farthest camera applies. null = no limit: some Gaussians end up more than a
    thousand kilometres away (docs/exports.md)."""
    gaussians: GaussianSettings = GaussianSettings()
    actors: ActorSettings = ActorSettings()
    deformable: DeformableSettings = DeformableSettings()
    drifting: DriftingSettings = DriftingSettings()
    mcmc: McmcSettings = McmcSettings()
    default: DefaultSettings = DefaultSettings()
    floaters: FloaterSettings = FloaterSettings()
    exposure: ExposureSettings = ExposureSettings()
    coarse_to_fine: CoarseToFineSettings = CoarseToFineSettings()
    scans: ScanTrainingSettings = ScanTrainingSettings()
    refine_start: float = Field(0.0167, ge=0, le=1)
    """Fraction of the iterations after which densification starts."""
    refine_stop: float = Field(0.833, ge=0, le=1)
    """Fraction of the iterations after which densification stops."""
    averaged: float = Field(0.1, ge=0, le=1)
    """Fraction of the iterations, the last ones, over which all parameters are averaged: at most those after
    `refine_stop`. Their mean shows held-out images better than their last values (docs/tried.md). 0 = no average."""
    sh_every: float = Field(0.0333, ge=0, le=1)
    """Fraction of the iterations after which the degree of the spherical harmonics rises by one, repeatedly."""
    ssim_weight: float = Field(0.2, ge=0, le=1)
    """Weight w of the colour loss (1 - w) L1 + w (1 - SSIM)."""
    opacity_reg: float = Field(0.01, ge=0)
    """Loss weight of the mean opacity. It fades Gaussians that the images do not need."""
    scale_reg: float = Field(0.01, ge=0)
    """Loss weight of the mean scale (metres)."""
    dropout: float = Field(0.0, ge=0, lt=1)
    """Fraction of the Gaussians of static parts that each iteration with an image leaves out at random: no surface may
    depend on a single Gaussian (docs/off_the_lane.md)."""
    dropout_images: int = Field(20, ge=1)
    """Number of training images per camera up to which `dropout` applies in full. With more images there is less
    overfitting: `dropout` is then multiplied by this number and divided by theirs."""
    flatness_weight: float = Field(0.0, ge=0)
    """Loss weight of the mean thickness of background Gaussians (their smallest scale, metres)."""
    road_weight: float = Field(0.0, ge=0)
    """Loss weight of the distance (metres) between Gaussians near the road and its surface (docs/off_the_lane.md)."""
    road: RoadSettings = RoadSettings()
    sky_alpha_weight: float = Field(0.05, ge=0)
    """Loss weight of -log(1 - alpha) in sky pixels, with `sky: mask` only."""
    sky_bce_weight: float = Field(0.0, ge=0)
    """Loss weight of the binary cross entropy between alpha and the inverse sky mask, for every kind of sky."""
    horizon_weight: float = Field(0.0, ge=0)
    """Loss weight of -ln(alpha) in pixels below the horizon where masks know no sky. docs/real_logs.md"""
    depth_weight: float = Field(0.0, ge=0)
    """Loss weight of the mean absolute difference from LiDAR depth (metres), without the worst 5 % of pixels."""
    smoothness_weight: float = Field(0.0, ge=0)
    """Loss weight of the unevenness of rendered surfaces: the mean absolute second difference of inverse depth between
    neighbouring pixels, divided by inverse depth; clipped and down-weighted at edges (docs/off_the_lane.md)."""
    entropy_weight: float = Field(0.005, ge=0)
    """Loss weight of the entropy of the alpha of objects, which favours opaque or absent ones. Only with parts that
    consist of objects. Without CUDA kernels objects are rendered alone for it, which takes time."""
    dynamic_weight: float = Field(0.1, ge=0)
    """Loss weight of the mean absolute colour difference over the pixels of moving objects. Only with parts that
    consist of objects."""
    semantic_weight: float = Field(0.0, ge=0)
    """Loss weight of the cross entropy between rendered class logits and your class maps (masks.semantic_folder). No
    effect without maps."""
    sky_resolution: int = Field(128, ge=2, le=2048)
    """Resolution of each face of the sky's cube map (texels)."""
    lr_sky: float = Field(1e-2, gt=0)
    """Learning rate of the sky's colours (logits)."""
    antialiased: bool = False
    """Use Mip-Splatting's 2D filter instead of the dilation of 3DGS."""
    max_scale: float = Field(0.0, ge=0)
    """Maximum standard deviation of Gaussians in images, as a fraction of their distance from the camera: larger ones
    are rendered as smaller ones. 0 = no limit. A limit may open holes (docs/off_the_lane.md)."""
    rolling_shutter: bool = True
    """Render the rolling shutter of cameras whose dataset states its readout time and direction: each Gaussian where
    it is at the time of its line. false: as if all lines were recorded at the image's timestamp."""
    checkpoint_every: int = Field(500, ge=1)
    """Iterations between resume checkpoints. Slow iterations are saved every minute as well."""
    min_checkpoint_interval_s: float = Field(60.0, ge=0)
    """Minimum time between resume checkpoints (seconds). More frequent ones would slow down short trainings."""
    cuda_graphs: bool = True
    """Capture iterations as CUDA graphs and replay them, on a GPU with strategy: mcmc. Otherwise Python launches each
    of hundreds of kernels. Results agree within rounding."""
    log_every: int = Field(100, ge=1)
    """Iterations between TensorBoard scalars, and between checks that losses and gradients are finite."""
    image_every: int = Field(5_000, ge=1)
    """Iterations between TensorBoard images. The last iteration has one, too."""
    psnr_every: int = Field(1_000, ge=0)
    """Iterations between TensorBoard's PSNRs of a few training and held-out images, of these by group and of static and
    moving pixels. The last iteration has them, too. 0: none."""

    @model_validator(mode="after")
    def _terms_have_what_they_need(self) -> "TrainSettings":
        if self.scans.per_image and self.strategy != "mcmc":
            raise ValueError("scans.per_image needs strategy: mcmc, since densification by gradient knows images alone")
        if self.floaters.below_road and not self.road_weight:
            raise ValueError("floaters.below_road needs road_weight above 0: without it the road is not known")
        return self

    def for_parts(self, parts: tuple[PartName, ...]) -> "TrainSettings":
        """These settings with those at their defaults that have no effect on a method of `parts`: those of other moving
        parts and, without any part that consists of objects, the loss weights of objects."""
        fields = [part for part in MOVING_PARTS if part not in parts]
        if not set(STAGE_OF_PART) & set(parts):
            fields += ["entropy_weight", "dynamic_weight"]
        return self.model_copy(update={name: type(self).model_fields[name].default for name in fields})


class TrainJob(Settings):
    """All settings that determine one checkpoint."""

    parts: tuple[PartName, ...]
    sky: SkyKind
    train: TrainSettings
    random_seed: int
    reference_camera: str | None = None
    """The camera that fixes the brightness of the model. None where exposures are not learned."""
