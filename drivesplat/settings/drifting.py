"""Settings of the part `drifting`: Gaussians that move and live for a while."""

from typing import Annotated

from pydantic import AfterValidator, Field

from drivesplat.settings import Settings


def _increasing(values: tuple[float, float]) -> tuple[float, float]:
    if values[0] > values[1]:
        raise ValueError("the first value must not exceed the second")
    return values


Depths = Annotated[tuple[Annotated[float, Field(gt=0)], Annotated[float, Field(gt=0)]], AfterValidator(_increasing)]
Factors = Annotated[tuple[float, float], AfterValidator(_increasing)]


class DriftingSeedSettings(Settings):
    """Initial Gaussians, at random places before the training cameras."""

    fraction: float = Field(0.5, gt=0, le=1)
    """Number of initial Gaussians, as a fraction of the maximum."""
    depths: Depths = (4.0, 60.0)
    """Range of their distances from the camera (metres), log-uniform."""
    height: float = Field(3.0, ge=0)
    """Maximum height above the ground under the vehicle (metres)."""
    speeds: Factors = (-1.0, 1.5)
    """Range of their velocities in multiples of the ego vehicle's, uniform: oncoming traffic to faster traffic."""
    spread: float = Field(2.0, ge=0)
    """Standard deviation of further horizontal velocities (m/s), for what crosses, and where the ego vehicle stands."""
    opacity: float = Field(0.1, gt=0, lt=1)
    """Initial opacity. More opaque Gaussians learn more of moving objects and cost more of the static world."""
    span: float = Field(1.0, gt=0)
    """Initial life span (seconds), at least `min_span`."""


class DriftingSettings(Settings):
    """The part `drifting`: Gaussians with a velocity, a life peak and a life span, which need no boxes
    (docs/without_boxes.md)."""

    fraction: float = Field(0.25, gt=0, le=1)
    """Maximum number of its Gaussians, as a fraction of the maximum of the background's."""
    seed: DriftingSeedSettings = DriftingSeedSettings()
    min_span: float = Field(0.3, gt=0)
    """Minimum life span (seconds): the standard deviation of opacity over time. Shorter ones show single images."""
    lr_means: float = Field(0.01, gt=0)
    """Initial learning rate of positions (metres). It decays as that of all positions does."""
    lr_velocities: float = Field(0.05, gt=0)
    """Initial learning rate of velocities (m/s). It decays, too."""
    lr_peaks: float = Field(0.01, gt=0)
    """Learning rate of life peaks (seconds)."""
    lr_spans: float = Field(0.01, gt=0)
    """Learning rate of the logarithm of life spans."""
