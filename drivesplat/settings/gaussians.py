"""Initial values and learning rates of Gaussians."""

from pydantic import Field

from drivesplat.settings import Settings


class GaussianSettings(Settings):
    """Initial values and learning rates of Gaussians. Learning rates are those of gsplat's example trainer."""

    sh_degree: int = Field(1, ge=0, le=3)
    """Degree of the spherical harmonics of the colours. A drive shows objects from few directions; degree 3 gives the
    same held-out PSNR with twice the memory (docs/measured.md)."""
    init_opacity: float = Field(0.1, gt=0, lt=1)
    """Initial opacity of seed Gaussians."""
    init_scale: float = Field(0.4, gt=0, le=10)
    """Initial scale of a seed Gaussian, in units of the root mean square distance to its three nearest neighbours.
    Small and faint seeds give higher PSNR where LiDAR is dense."""
    lr_means: float = Field(1.6e-4, gt=0)
    """Learning rate of positions, in units of the scene scale. Decays exponentially to a hundredth."""
    lr_scales: float = Field(5e-3, gt=0)
    """Learning rate of log scales."""
    lr_quats: float = Field(1e-3, gt=0)
    """Learning rate of rotations."""
    lr_opacities: float = Field(5e-2, gt=0)
    """Learning rate of opacity logits."""
    lr_sh0: float = Field(2.5e-3, gt=0)
    """Learning rate of the colours' constant term."""
    lr_classes: float = Field(1e-2, gt=0)
    """Learning rate of class logits, where class maps are given (masks.semantic_folder)."""
    lr_shN: float = Field(1.25e-4, gt=0)
    """Learning rate of the colours' view-dependent terms."""
