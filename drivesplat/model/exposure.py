"""Exposure and white balance of each camera of a rig."""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn

from drivesplat.settings.train_cameras import ExposureSettings

CHANNELS = ("red", "green", "blue")


class Exposures(nn.Module):
    """For each listed camera an affine map of every colour channel: c becomes f exp(g) c + o. `first` holds the initial
    gains f (3,) estimated before the training; `params` what is learned: log gains g (row 0) and offsets o (row 1),
    (2, 3) a camera, in units of their expected size, initially 0.

    Other cameras keep the model's colours: the reference camera, which fixes the brightness of the scene, and cameras
    without training images.
    """

    def __init__(self, first: Mapping[str, Tensor], settings: ExposureSettings):
        super().__init__()
        self.first = nn.ParameterDict(
            {camera: nn.Parameter(gains, requires_grad=False) for camera, gains in first.items()}
        )
        self.params = nn.ParameterDict({camera: nn.Parameter(torch.zeros(2, 3)) for camera in first})
        self._settings = settings

    def applied(self, image: Float[Tensor, "h w 3"], camera: str | None) -> Float[Tensor, "h w 3"]:
        """Maps an image from the model's colours to those of `camera`."""
        if camera not in self.params:
            return image
        gains, offsets = self._map(camera)
        return image * gains + offsets

    def penalty(self, camera: str | None) -> Float[Tensor, ""] | None:
        """The weighted mean square of a camera's parameters; None without parameters or weight."""
        if camera not in self.params or not self._settings.weight:
            return None
        return self._settings.weight * self.params[camera].square().mean()

    def _map(self, camera: str) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Gains and offsets of a camera."""
        log_gains, offsets = self.params[camera]
        gains = self.first[camera] * torch.exp(self._settings.sigma_gain * log_gains)
        return gains, self._settings.sigma_offset * offsets

    def learning_rates(self) -> dict[str, float]:
        """The initial learning rate of every camera's entry of `params`."""
        return dict.fromkeys(self.params, self._settings.learning_rate)

    def figures(self) -> dict[str, float]:
        """Every gain and offset by name: 'CAM_BACK/gain_red'. Waits for the device."""
        if not len(self.params):
            return {}
        values = torch.stack([torch.stack(self._map(camera)) for camera in self.params]).detach().reshape(-1).tolist()
        names = (f"{camera}/{name}_{c}" for camera in self.params for name in ("gain", "offset") for c in CHANNELS)
        return dict(zip(names, values, strict=True))
