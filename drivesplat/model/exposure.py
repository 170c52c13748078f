"""How the cameras of a rig show colours: each exposes and white-balances by itself."""

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from drivesplat.settings.train import ExposureSettings

CHANNELS = ("red", "green", "blue")


class Exposures(nn.Module):
    """For each of `cameras` an affine map of every colour channel: c is shown as exp(g) c + o. `params` hold log gains
    (row 0) and offsets (row 1), (2, 3) a camera, in units of how much they are expected to be. They begin at 0.

    Any other camera shows colours as they are: the reference, without which gains and the brightness of the scene could
    trade places, and cameras that recorded no training image.
    """

    def __init__(self, cameras: Iterable[str], settings: ExposureSettings):
        super().__init__()
        self.params = nn.ParameterDict({camera: nn.Parameter(torch.zeros(2, 3)) for camera in cameras})
        self._settings = settings

    def shown(self, image: Float[Tensor, "h w 3"], camera: str | None) -> Float[Tensor, "h w 3"]:
        """An image in the model's colours as `camera` shows it."""
        if camera not in self.params:
            return image
        gains, offsets = self._map(self.params[camera])
        return image * gains + offsets

    def penalty(self, camera: str | None) -> Float[Tensor, ""] | None:
        """The weighted mean square of a camera's parameters; None where there are none to be paid for."""
        if camera not in self.params or not self._settings.weight:
            return None
        return self._settings.weight * self.params[camera].square().mean()

    def _map(self, params: Float[Tensor, "*c 2 3"]) -> tuple[Float[Tensor, "*c 3"], Float[Tensor, "*c 3"]]:
        """Gains and offsets."""
        log_gains, offsets = params.unbind(dim=-2)
        return torch.exp(self._settings.sigma_gain * log_gains), self._settings.sigma_offset * offsets

    def learning_rates(self) -> dict[str, float]:
        """The initial learning rate of every camera's entry of `params`."""
        return dict.fromkeys(self.params, self._settings.learning_rate)

    def figures(self) -> dict[str, float]:
        """Every gain and offset by its name: 'CAM_BACK/gain_red'. Waits for the device."""
        if not len(self.params):
            return {}
        values = torch.stack(self._map(torch.stack([*self.params.values()]).detach()), dim=1).reshape(-1).tolist()
        names = (f"{camera}/{name}_{c}" for camera in self.params for name in ("gain", "offset") for c in CHANNELS)
        return dict(zip(names, values, strict=True))
