"""Settings of what a training learns of cameras: poses and exposures."""

from typing import Literal

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


class ExposureSettings(Settings):
    """Exposure of each camera. Cameras of one rig set exposure and white balance independently, which causes seams
    where their images overlap."""

    kind: Literal["none", "affine"] = "affine"
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
