"""Corrections of camera poses that are learned in training."""

from pydantic import Field

from drivesplat.settings import Settings


class CameraPoseSettings(Settings):
    """Bounded, smooth corrections of every training image's camera pose, learned along with the Gaussians. Held-out
    images, and all times between training images, get what lies between their neighbours' corrections.

    For what is left after `refine_poses`, or instead of it. Without bounds training images drift away from held-out
    ones: better there, worse here.
    """

    corrected: bool = False
    """Whether anything is corrected at all."""
    max_shift: float = Field(0.05, gt=0, le=1)
    """No camera is moved by more than this (metres) along any of its axes."""
    max_turn: float = Field(0.3, gt=0, le=10)
    """None is turned by more than this (degrees) about any of them."""
    learning_rate: float = Field(2e-3, gt=0)
    """Learning rate, in fractions of these bounds; decays exponentially to a hundredth."""
    size_weight: float = Field(0.001, ge=0)
    """Weight of the mean square of the corrections, in fractions of the bounds: given poses are trusted so far."""
    bend_weight: float = Field(0.01, ge=0)
    """Weight of the mean square of their second differences from image to image, in the same units: corrections change
    slowly."""
