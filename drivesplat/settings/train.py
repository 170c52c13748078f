"""Settings of the rule `train`."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from drivesplat.settings import Settings
from drivesplat.settings.actors import ActorSettings
from drivesplat.settings.camera_poses import CameraPoseSettings
from drivesplat.settings.coarse_to_fine import CoarseToFineSettings
from drivesplat.settings.gaussians import GaussianSettings
from drivesplat.settings.road import RoadSettings

PartName = Literal["background", "actors"]
STAGE_OF_PART: dict[PartName, str] = {"actors": "actors"}
"""The parts whose Gaussians are objects that move, and the stage that finds these objects in a scene."""
SkyKind = Literal["none", "mask", "cubemap"]


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


class McmcSettings(Settings):
    """strategy: mcmc. 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024), gsplat's
    MCMCStrategy."""

    noise_lr: float = Field(5e5, ge=0)
    """Strength of the exploration noise on positions."""
    min_opacity: float = Field(0.005, gt=0, lt=1)
    """Opacity below which Gaussians are relocated."""
    refine_every: int = Field(100, ge=1)
    """Iterations between densification steps (relocation and growth)."""
    growth: float = Field(0.05, ge=0)
    """Growth factor per densification step: the number of Gaussians grows by this fraction, up to the limit."""


class DefaultSettings(Settings):
    """strategy: default. Densification by screen-space gradient (Kerbl et al. 2023), gsplat's DefaultStrategy."""

    grow_grad2d: float = Field(2e-4, gt=0)
    """Mean screen-space gradient above which Gaussians are split or duplicated."""
    prune_opacity: float = Field(0.005, gt=0, lt=1)
    """Opacity below which Gaussians are removed."""
    absgrad: bool = False
    """Use absolute gradients. Needs a larger grow_grad2d (8e-4 in gsplat's example)."""
    refine_every: int = Field(100, ge=1)
    """Iterations between densifications."""
    reset_every: int = Field(3000, ge=1)
    """Iterations between resets of all opacities."""


class FloaterSettings(Settings):
    radius: float = Field(1.0, ge=0, le=10)
    """Distance from the path of the training cameras (metres) within which Gaussians are faded out: the ego vehicle
    drove there, so the space is empty. 0 = off."""
    free_space: bool = False
    """Also fade out Gaussians whose centres lie in space that LiDAR rays prove empty (see `free_space`)."""
    every: int = Field(100, ge=1)
    """Iterations between these steps."""


class ExposureSettings(Settings):
    """Exposure of each camera. Cameras of one rig set exposure and white balance independently, which causes seams
    where their images overlap."""

    kind: Literal["none", "affine"] = "none"
    """'affine': a gain and an offset per colour channel for every camera but eval_camera, which is the reference. They
    are initialised from surfaces that several cameras recorded, then learned. No effect with one camera."""
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


class TrainSettings(Settings):
    iterations: int = Field(15_000, ge=1, le=1_000_000)
    """Number of optimisation steps, one image each."""
    strategy: Literal["mcmc", "default"] = "mcmc"
    """Densification: 'mcmc', or 'default' (by gradient), which fills the space in front of sparse cameras."""
    cap_max: int = Field(1_500_000, ge=100, le=20_000_000)
    """Maximum number of Gaussians. GPU memory: about 0.4 GB per million, and as much again while rendering."""
    pixels_per_gaussian: float = Field(20.0, ge=0)
    """Minimum number of training pixels per Gaussian (0 disables the limit). More Gaussians overfit single views."""
    gaussians: GaussianSettings = GaussianSettings()
    actors: ActorSettings = ActorSettings()
    mcmc: McmcSettings = McmcSettings()
    default: DefaultSettings = DefaultSettings()
    floaters: FloaterSettings = FloaterSettings()
    exposure: ExposureSettings = ExposureSettings()
    camera_poses: CameraPoseSettings = CameraPoseSettings()
    coarse_to_fine: CoarseToFineSettings = CoarseToFineSettings()
    refine_start: float = Field(0.0167, ge=0, le=1)
    """Fraction of the iterations after which densification starts."""
    refine_stop: float = Field(0.833, ge=0, le=1)
    """Fraction of the iterations after which densification stops."""
    sh_every: float = Field(0.0333, ge=0, le=1)
    """Fraction of the iterations after which the degree of the spherical harmonics rises by one, repeatedly."""
    ssim_weight: float = Field(0.2, ge=0, le=1)
    """Weight w of the colour loss (1 - w) L1 + w (1 - SSIM)."""
    opacity_reg: float = Field(0.01, ge=0)
    """Loss weight of the mean opacity. It fades Gaussians that the images do not need."""
    scale_reg: float = Field(0.01, ge=0)
    """Loss weight of the mean scale (metres)."""
    flatness_weight: float = Field(0.0, ge=0)
    """Loss weight of the mean thickness of background Gaussians (their smallest scale, metres)."""
    road_weight: float = Field(0.0, ge=0)
    """Loss weight of the distance (metres) between Gaussians under the vehicle's path and the road surface there, which
    follows from the ego poses."""
    road: RoadSettings = RoadSettings()
    sky_alpha_weight: float = Field(0.05, ge=0)
    """Loss weight of -log(1 - alpha) in sky pixels, with `sky: mask` only."""
    sky_bce_weight: float = Field(0.0, ge=0)
    """Loss weight of the binary cross entropy between alpha and the inverse sky mask, for every kind of sky."""
    depth_weight: float = Field(0.0, ge=0)
    """Loss weight of the mean absolute difference from LiDAR depth (metres), without the worst 5 % of pixels."""
    entropy_weight: float = Field(0.1, ge=0)
    """Loss weight of the entropy of the moving parts' alpha, which favours opaque or absent objects. Only with moving
    parts."""
    dynamic_weight: float = Field(0.1, ge=0)
    """Loss weight of the mean absolute colour difference over the pixels of moving objects. Only with moving parts."""
    semantic_weight: float = Field(0.0, ge=0)
    """Loss weight of the cross entropy between rendered class logits and your class maps (masks.semantic_folder). No
    effect without maps."""
    sky_resolution: int = Field(128, ge=2, le=2048)
    """Resolution of each face of the sky's cube map (texels)."""
    lr_sky: float = Field(1e-2, gt=0)
    """Learning rate of the sky's colours (logits)."""
    antialiased: bool = False
    """Use Mip-Splatting's 2D filter instead of the dilation of 3DGS."""
    checkpoint_every: int = Field(500, ge=1)
    """Iterations between resume checkpoints."""
    checkpoint_apart_s: float = Field(60.0, ge=0)
    """Minimum time between resume checkpoints (seconds). More frequent ones would slow down short trainings."""
    cuda_graphs: bool = True
    """Capture iterations as CUDA graphs and replay them, on a GPU with strategy: mcmc. Otherwise Python launches each
    of hundreds of kernels. Results agree within rounding."""
    log_every: int = Field(100, ge=1)
    """Iterations between TensorBoard scalars, and between checks that losses and gradients are finite."""
    image_every: int = Field(5_000, ge=1)
    """Iterations between TensorBoard images."""

    def without_moving_parts(self) -> "TrainSettings":
        """These settings with those of moving parts at their defaults, for methods without moving parts."""
        fields = ("actors", "entropy_weight", "dynamic_weight")
        return self.model_copy(update={name: type(self).model_fields[name].default for name in fields})


class TrainJob(Settings):
    """All settings that determine one checkpoint."""

    parts: tuple[PartName, ...]
    sky: SkyKind
    train: TrainSettings
    random_seed: int
    reference_camera: str | None = None
    """The camera whose exposure the model has. None where exposures are not learned."""
