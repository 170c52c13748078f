"""The settings of a training."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from drivesplat.settings import Settings
from drivesplat.settings.actors import ActorSettings
from drivesplat.settings.camera_poses import CameraPoseSettings
from drivesplat.settings.coarse_to_fine import CoarseToFineSettings
from drivesplat.settings.gaussians import GaussianSettings
from drivesplat.settings.road import RoadSettings

PartName = Literal["background", "actors"]
MOVING_PARTS = frozenset({"actors"})
"""Those whose Gaussians are objects that move."""
SkyKind = Literal["none", "mask", "cubemap"]


def _complete(parts: tuple[PartName, ...]) -> tuple[PartName, ...]:
    """Refuses parts of which a scene where nothing moves would have none, and a part that would be trained twice."""
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
"""What a model may be made of."""


class McmcSettings(Settings):
    """strategy: mcmc. 3D Gaussian Splatting as Markov Chain Monte Carlo (Kheradmand et al. 2024), gsplat's
    MCMCStrategy."""

    noise_lr: float = Field(5e5, ge=0)
    """Strength of the exploration noise on positions."""
    min_opacity: float = Field(0.005, gt=0, lt=1)
    """Gaussians below it are dead and are relocated."""
    refine_every: int = Field(100, ge=1)
    """Iterations between relocations."""
    growth: float = Field(0.05, ge=0)
    """By so large a share their number grows at each of these, up to the cap."""


class DefaultSettings(Settings):
    """strategy: default. Densification by screen-space gradient (Kerbl et al. 2023), gsplat's DefaultStrategy."""

    grow_grad2d: float = Field(2e-4, gt=0)
    """Gaussians whose mean screen-space gradient exceeds it are split or duplicated."""
    prune_opacity: float = Field(0.005, gt=0, lt=1)
    """Gaussians below it are removed."""
    absgrad: bool = False
    """Use absolute gradients (needs a larger grow_grad2d, 8e-4 in gsplat's example)."""
    refine_every: int = Field(100, ge=1)
    """Iterations between densifications."""
    reset_every: int = Field(3000, ge=1)
    """Iterations between resets of all opacities."""


class FloaterSettings(Settings):
    radius: float = Field(1.0, ge=0, le=10)
    """Gaussians whose centre is nearer than this (metres) to the path of a training camera are faded out: the
    recording car drove there, so it is empty. Worth 1.5 dB of static PSNR on scene 0061. 0 = off."""
    free_space: bool = False
    """Whether those are faded out, too, whose centre lies where LiDAR's rays prove space empty (`free_space`)."""
    every: int = Field(100, ge=1)
    """Iterations between prunings."""


class ExposureSettings(Settings):
    """Cameras of one rig expose and white-balance by themselves, which shows as seams where their images meet."""

    kind: Literal["none", "affine"] = "none"
    """'affine': for every camera but eval_camera, which is the reference, a gain and an offset of each colour channel
    are applied to what it shows: found from surfaces that several cameras recorded, then learned. With one camera there
    is nothing to learn."""
    sigma_gain: float = Field(0.1, gt=0)
    """By how much (natural logarithm) a camera's gains are expected to differ from what was found."""
    sigma_offset: float = Field(0.02, gt=0)
    """By how much (1 = full scale) its offsets are from 0."""
    weight: float = Field(0.002, ge=0)
    """Weight of the mean square of a camera's log gains and offsets, in units of these, in the loss: what exposure need
    not explain it does not."""
    start: float = Field(0.1, ge=0, le=1)
    """Exposures are learned after this fraction of the iterations: before, the scene is what is wrong."""
    learning_rate: float = Field(1e-2, gt=0)
    """Learning rate of log gains and offsets, in the same units; decays exponentially to a hundredth."""


class TrainSettings(Settings):
    iterations: int = Field(15_000, ge=1, le=1_000_000)
    """Optimisation steps, one image each. Vanilla measures the same from 7,000 to 30,000 on scene 0061, held out."""
    strategy: Literal["mcmc", "default"] = "mcmc"
    """Densification: 'mcmc', or 'default' by gradient, which fills the air before the few cameras of a driving log."""
    cap_max: int = Field(1_500_000, ge=100, le=20_000_000)
    """Most Gaussians. Memory grows with it: about 0.4 GB per million, and as much again while rendering."""
    pixels_per_gaussian: float = Field(20.0, ge=0)
    """At most one Gaussian per so many training pixels (0 = no such limit). More Gaussians than that fit what no other
    view shows."""
    gaussians: GaussianSettings = GaussianSettings()
    actors: ActorSettings = ActorSettings()
    mcmc: McmcSettings = McmcSettings()
    default: DefaultSettings = DefaultSettings()
    floaters: FloaterSettings = FloaterSettings()
    exposure: ExposureSettings = ExposureSettings()
    camera_poses: CameraPoseSettings = CameraPoseSettings()
    coarse_to_fine: CoarseToFineSettings = CoarseToFineSettings()
    refine_start: float = Field(0.0167, ge=0, le=1)
    """Densification starts after this fraction of the iterations."""
    refine_stop: float = Field(0.833, ge=0, le=1)
    """Densification stops after this fraction of the iterations."""
    sh_every: float = Field(0.0333, ge=0, le=1)
    """The spherical harmonics gain a degree every so large a fraction of the iterations."""
    ssim_weight: float = Field(0.2, ge=0, le=1)
    """The colour loss is (1 - w) L1 + w (1 - SSIM)."""
    opacity_reg: float = Field(0.01, ge=0)
    """Weight of the mean opacity in the loss: what is not needed fades."""
    scale_reg: float = Field(0.01, ge=0)
    """Weight of the mean scale (metres) in the loss: what is large must earn it."""
    flatness_weight: float = Field(0.0, ge=0)
    """Weight of the background Gaussians' mean thickness (metres, their smallest scale) in the loss: surfaces are
    flat."""
    road_weight: float = Field(0.0, ge=0)
    """Weight of how far (metres) the mass of Gaussians under the car's path lies from the road there, whose height and
    slope the car's poses tell."""
    road: RoadSettings = RoadSettings()
    sky_alpha_weight: float = Field(0.05, ge=0)
    """Weight of -log(1 - alpha) on sky pixels with `sky: mask`: no Gaussian in the sky. A cube map does without:
    it cost 0.5 dB of static PSNR on scene 0061, where masks and tree tops disagree."""
    sky_bce_weight: float = Field(0.0, ge=0)
    """Weight of the cross entropy between alpha and the absence of sky, whatever the sky is: no Gaussian in sky pixels,
    and no sky in the others."""
    depth_weight: float = Field(0.0, ge=0)
    """Weight of the mean absolute difference (metres) from LiDAR's depth, the worst 5 % of pixels left out."""
    entropy_weight: float = Field(0.1, ge=0)
    """Weight of the entropy of the moving parts' own alpha: an object is there or it is not. Only with such parts."""
    dynamic_weight: float = Field(0.1, ge=0)
    """Weight of the mean absolute colour difference over the pixels of what moves. Only with moving parts."""
    semantic_weight: float = Field(0.0, ge=0)
    """Weight of the cross entropy between rendered class logits and your maps of classes (masks.semantic_folder).
    Without maps it does nothing."""
    sky_resolution: int = Field(128, ge=2, le=2048)
    """Texels along an edge of the sky's cube map."""
    lr_sky: float = Field(1e-2, gt=0)
    """Learning rate of the sky's colours (logits)."""
    antialiased: bool = False
    """Mip-Splatting's 2D filter instead of 3DGS's dilation."""
    checkpoint_every: int = Field(500, ge=1)
    """Iterations between resume checkpoints."""
    checkpoint_apart_s: float = Field(60.0, ge=0)
    """Seconds between them at least: they hold a short training up for longer than they can save."""
    cuda_graphs: bool = True
    """Whether iterations are recorded as CUDA graphs and replayed, on a GPU, with strategy: mcmc: otherwise Python asks
    for each of their hundreds of kernels by itself. What is learned is the same within rounding."""
    log_every: int = Field(100, ge=1)
    """Iterations between TensorBoard scalars, and between checks that all losses and gradients are finite."""
    image_every: int = Field(5_000, ge=1)
    """Iterations between TensorBoard images."""

    def of_what_stands_still(self) -> "TrainSettings":
        """Itself with all that concerns moving parts at its default: a method without such parts does not know it."""
        fields = ("actors", "entropy_weight", "dynamic_weight")
        return self.model_copy(update={name: type(self).model_fields[name].default for name in fields})


class TrainJob(Settings):
    """Everything that decides the content of one checkpoint, its inputs aside."""

    parts: tuple[PartName, ...]
    sky: SkyKind
    train: TrainSettings
    random_seed: int
    reference_camera: str | None = None
    """The camera whose exposure is that of the model, where exposures are learned; None where they are not."""
