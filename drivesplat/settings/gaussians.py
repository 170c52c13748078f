"""How Gaussians start and learn."""

from pydantic import Field

from drivesplat.settings import Settings


class GaussianSettings(Settings):
    """How Gaussians start and how fast they learn; learning rates are gsplat's example's."""

    sh_degree: int = Field(1, ge=0, le=3)
    """Highest degree of the spherical harmonics that hold the colours. A drive sees things from few directions: on
    scene 0061 degree 3 measures the same, held out, with twice the memory."""
    init_opacity: float = Field(0.1, gt=0, lt=1)
    """Opacity of seed Gaussians."""
    init_scale: float = Field(0.4, gt=0, le=10)
    """Size of a seed Gaussian in units of the root mean square distance to its three neighbours. Small and faint wins
    where LiDAR is dense: 5 dB of static PSNR on the demo world over 1.0 and an opacity of 0.5."""
    lr_means: float = Field(1.6e-4, gt=0)
    """Learning rate of positions, times the scene's scale; decays exponentially to a hundredth."""
    lr_scales: float = Field(5e-3, gt=0)
    """Learning rate of log scales."""
    lr_quats: float = Field(1e-3, gt=0)
    """Learning rate of rotations."""
    lr_opacities: float = Field(5e-2, gt=0)
    """Learning rate of opacity logits."""
    lr_sh0: float = Field(2.5e-3, gt=0)
    """Learning rate of the colours' constant term."""
    lr_classes: float = Field(1e-2, gt=0)
    """Learning rate of the logits of classes, where maps of classes are given."""
    lr_shN: float = Field(1.25e-4, gt=0)
    """Learning rate of the colours' view-dependent terms."""
