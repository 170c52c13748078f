"""Settings of what a training learns of cameras."""

from typing import Literal

from pydantic import Field

from drivesplat.settings import Settings


class ExposureSettings(Settings):
    """Exposure of each camera. Cameras of one rig set exposure and white balance independently, which causes seams
    where their images overlap, and change them while the vehicle drives."""

    kind: Literal["none", "affine"] = "affine"
    """'affine': a gain and an offset per colour channel for every camera but eval_camera, which is the reference. They
    are initialised from surfaces that several cameras recorded, then learned; and gains over time of every camera
    (`interval`)."""
    interval: float | None = Field(1.0, ge=0.1, le=60)
    """Seconds between the times at which gains of every camera, eval_camera included, are learned; linear in between
    and constant beyond the last training image. null: constant exposures."""
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
