"""Settings of camera pose corrections that a training learns."""

from pydantic import Field

from drivesplat.settings import Settings


class CameraPoseSettings(Settings):
    """Bounded, smooth corrections of the camera poses of training images, learned along with the Gaussians. Held-out
    images and all other times take interpolated corrections.

    Applies after `refine_poses`, or instead of it. Unbounded corrections raise training PSNR and lower held-out PSNR,
    since training poses drift away from held-out poses.
    """

    corrected: bool = False
    """Correct camera poses during training."""
    max_shift: float = Field(0.05, gt=0, le=1)
    """Maximum translation of a camera along each of its axes (metres)."""
    max_turn: float = Field(0.3, gt=0, le=10)
    """Maximum rotation of a camera about each of its axes (degrees)."""
    learning_rate: float = Field(2e-3, gt=0)
    """Learning rate, in fractions of these bounds. Decays exponentially to a hundredth."""
    size_weight: float = Field(0.001, ge=0)
    """Loss weight of the mean square of the corrections, in fractions of the bounds."""
    bend_weight: float = Field(0.01, ge=0)
    """Loss weight of the mean square of their second differences from image to image, in the same units."""
