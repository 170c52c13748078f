"""Exposure and white balance of each camera: between the cameras of a rig, and over time."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from drivesplat.model.view import View
from drivesplat.settings.train_cameras import ExposureSettings

CHANNELS = ("red", "green", "blue")
CHANGE_RATIO = 2.0
"""Expected size of log gains over their expected change within a second, a random walk."""
LEAK = 0.05
"""Slope of colours beyond saturation, so that what is too bright keeps a gradient."""
DARKEST = 1e-3
"""Smallest mean of an image to which exposures respond (1 = full scale)."""


@dataclass(frozen=True)
class ExposureStart:
    """What exposures start from. `first`: gains (3,) of cameras beside the reference camera. At the k times `nodes`
    (seconds, at even intervals) gains change; `found`, of each camera, (1 + k, 3): its response b and its log gains
    there. `brightness`: the mean of an image (1 = full scale) at which the response is 0."""

    first: Mapping[str, Tensor] = field(default_factory=dict)
    nodes: Float[Tensor, " k"] = field(default_factory=lambda: torch.zeros(0))
    found: Mapping[str, Float[Tensor, "r 3"]] = field(default_factory=dict)
    brightness: float = 0.5


class Learned(NamedTuple):
    """What is learned of a camera, in units of its expected size: log gain and offset (2, 3), or none (0, 3); the
    response b and the log gains over time (1 + k, 3), as deviations from what was found, or none (0, 3)."""

    constants: Float[Tensor, "c 3"]
    over_time: Float[Tensor, "r 3"]


class Exposures(nn.Module):
    """Maps of every colour channel, by camera and time t: c becomes f exp(g(t) - b log(m / M) + g) c + o.

    Over time, splats without sky change, up to saturation; a bright sky stays as it is. Log gains g(t) are linear
    between nodes and constant beyond. The automatic response b to the mean m of an image, relative to M, goes on
    beyond: an ideal exposure control has b = 1. Both are what was found before the training (`ExposureStart`) plus what
    is learned. Gain and offset of a camera in `first` apply to the image with sky.

    `params` is what is learned of each camera, (r, 3), initially 0, in the order of `Learned`.

    Views without a camera, and cameras without parameters, keep the model's colours. The reference camera has no
    constants: it fixes the brightness of the scene.
    """

    def __init__(self, start: ExposureStart, settings: ExposureSettings):
        super().__init__()
        self.register_buffer("nodes", start.nodes.clone())
        self.register_buffer("brightness", torch.tensor(start.brightness))
        self.first, self.found = (
            nn.ParameterDict({camera: nn.Parameter(it.clone(), requires_grad=False) for camera, it in values.items()})
            for values in (start.first, start.found)
        )
        cameras = sorted({*start.first, *start.found})
        rows = {camera: 2 * (camera in self.first) + len(start.found.get(camera, ())) for camera in cameras}
        self.params = nn.ParameterDict({camera: nn.Parameter(torch.zeros(count, 3)) for camera, count in rows.items()})
        self._settings = settings

    def over_time(
        self, splats: Float[Tensor, "h w 3"], alpha: Float[Tensor, "h w 1"], view: View
    ) -> Float[Tensor, "h w 3"]:
        """Maps splats without sky from the model's colours to those at the view's time. For the mean of the image the
        sky counts as white."""
        if view.camera not in self.found:
            return splats
        found, settings, own = self.found[view.camera], self._settings, self.learned(view.camera).over_time
        mean = 1.0 + (splats.detach() - alpha.detach()).mean()
        brighter = (mean.clamp(min=DARKEST) / self.brightness).log()
        response = found[0] + settings.sigma_response * own[0]
        changing = found[1:] + settings.sigma_gain * own[1:]
        exposed = splats * torch.exp(self._weights(view.moment) @ changing - response * brighter)
        return torch.minimum(exposed, 1.0 + LEAK * (exposed - 1.0))

    def of_camera(self, image: Float[Tensor, "h w 3"], view: View) -> Float[Tensor, "h w 3"]:
        """Maps an image with sky from the colours of the reference camera to those of the view's camera."""
        if view.camera not in self.first:
            return image
        constants, settings = self.learned(view.camera).constants, self._settings
        gains = self.first[view.camera] * torch.exp(settings.sigma_gain * constants[0])
        return image * gains + settings.sigma_offset * constants[1]

    def penalty(self, camera: str | None) -> Float[Tensor, ""] | None:
        """The weighted sum of the mean squares of what is learned of a camera: of its constants, of its response, of
        its log gains over time and of their changes; None without parameters or weight."""
        if camera not in self.params or not self._settings.weight:
            return None
        own = self.learned(camera)
        changing = own.over_time[1:]
        squares = [rows.square().mean() for rows in (own.constants, own.over_time[:1], changing) if len(rows)]
        if len(changing):
            squares.append((CHANGE_RATIO * changing.diff(dim=0)).square().mean() / (self.nodes[1] - self.nodes[0]))
        return self._settings.weight * torch.stack(squares).sum()

    def learned(self, camera: str) -> Learned:
        """The parameters of a camera."""
        values, constant = self.params[camera], 2 if camera in self.first else 0
        return Learned(values[:constant], values[constant:])

    def _weights(self, seconds: Float[Tensor, ""]) -> Float[Tensor, " k"]:
        """The weight of each node at a time."""
        within = torch.minimum(torch.maximum(seconds, self.nodes[0]), self.nodes[-1])
        return (1.0 - (within - self.nodes).abs() / (self.nodes[1] - self.nodes[0])).clamp(min=0.0)

    def learning_rates(self) -> dict[str, float]:
        """The initial learning rate of every camera's entry of `params`."""
        return dict.fromkeys(self.params, self._settings.learning_rate)

    @torch.no_grad()
    def figures(self) -> dict[str, float]:
        """By name, constant gains and offsets ('CAM_BACK/gain_red'), responses ('CAM_BACK/response_red'), and the
        smallest and the largest factor of any channel over time ('CAM_BACK/factor_least', 'CAM_BACK/factor_largest').
        Waits for the device."""
        figures, settings = {}, self._settings
        for camera in self.params:
            own = self.learned(camera)
            by_channel = {}
            if len(own.constants):
                by_channel["gain"] = self.first[camera] * torch.exp(settings.sigma_gain * own.constants[0])
                by_channel["offset"] = settings.sigma_offset * own.constants[1]
            if len(own.over_time):
                by_channel["response"] = self.found[camera][0] + settings.sigma_response * own.over_time[0]
                changing = self.found[camera][1:] + settings.sigma_gain * own.over_time[1:]
                figures[f"{camera}/factor_least"] = float(changing.min().exp())
                figures[f"{camera}/factor_largest"] = float(changing.max().exp())
            for name, values in by_channel.items():
                figures |= {f"{camera}/{name}_{c}": v for c, v in zip(CHANNELS, values.tolist(), strict=True)}
        return figures
