"""Exposure and white balance of each camera: between the cameras of a rig, and over time."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from drivesplat.model.view import View
from drivesplat.settings.train_cameras import ExposureSettings

CHANNELS = ("red", "green", "blue")
CHANGE_RATIO = 2.0
"""Expected size of log gains over their expected change within a second, a random walk."""
DARKEST = 1e-3
"""Smallest mean of an image to which exposures respond (1 = full scale)."""


class Learned(NamedTuple):
    """What is learned of a camera, in units of its expected size: log gain and offset (2, 3), or none (0, 3); the
    response b (3,) and the log gains (k, 3) over time."""

    constants: Float[Tensor, "c 3"]
    response: Float[Tensor, "3"]
    changing: Float[Tensor, "k 3"]


class Exposures(nn.Module):
    """An affine map of every colour channel, by camera and time t: c becomes f exp(g + g(t) - b log(m / M)) c + o.

    `first` holds the initial gains f (3,) of the cameras with constants, estimated before the training. `params` is
    what is learned of each camera, (r, 3), initially 0, in the order of `Learned`: log gain g and offset o, only of
    these cameras; then, with k `nodes` (seconds), the camera's automatic response b to the mean m of its image in the
    model's colours, relative to `brightness` M, and the log gains g(t) at the nodes, which follow it late or for other
    reasons. Between nodes g(t) is linear, beyond them constant, while b goes on: an ideal exposure control has b = 1.

    Cameras without parameters, and views without a camera, keep the model's colours. The reference camera has no
    constants: it fixes the brightness of the scene.
    """

    def __init__(
        self,
        first: Mapping[str, Tensor],
        settings: ExposureSettings,
        cameras: tuple[str, ...] = (),
        nodes: Float[Tensor, " k"] | None = None,
        brightness: float = 0.5,
    ):
        """`cameras` without constants, besides those in `first`."""
        super().__init__()
        self.register_buffer("nodes", torch.zeros(0) if nodes is None else nodes)
        self.register_buffer("brightness", torch.tensor(brightness))
        self.first = nn.ParameterDict(
            {camera: nn.Parameter(gains, requires_grad=False) for camera, gains in first.items()}
        )
        over_time = 1 + len(self.nodes) if len(self.nodes) else 0
        rows = {**dict.fromkeys(cameras, over_time), **dict.fromkeys(first, 2 + over_time)}
        self.params = nn.ParameterDict(
            {camera: nn.Parameter(torch.zeros(rows[camera], 3)) for camera in sorted(rows) if rows[camera]}
        )
        self._settings = settings

    def applied(self, image: Float[Tensor, "h w 3"], view: View) -> Float[Tensor, "h w 3"]:
        """Maps an image from the model's colours to those of the view's camera at its time."""
        if view.camera not in self.params:
            return image
        own, settings = self.learned(view.camera), self._settings
        log_gains, offsets = image.new_zeros(3), 0.0
        if len(own.constants):
            log_gains, offsets = settings.sigma_gain * own.constants[0], settings.sigma_offset * own.constants[1]
            log_gains = log_gains + self.first[view.camera].log()
        if len(own.changing):
            brighter = (image.detach().mean().clamp(min=DARKEST) / self.brightness).log()
            response = settings.sigma_response * own.response * brighter
            log_gains = log_gains + settings.sigma_gain * self._weights(view.moment) @ own.changing - response
        return image * torch.exp(log_gains) + offsets

    def penalty(self, camera: str | None) -> Float[Tensor, ""] | None:
        """The weighted sum of the mean squares of a camera's constants, of its response, of its log gains over time and
        of their changes; None without parameters or weight."""
        if camera not in self.params or not self._settings.weight:
            return None
        own = self.learned(camera)
        squares = [values.square().mean() for values in (own.constants, own.response, own.changing) if len(values)]
        if len(own.changing):
            squares.append((CHANGE_RATIO * own.changing.diff(dim=0)).square().mean() / (self.nodes[1] - self.nodes[0]))
        return self._settings.weight * torch.stack(squares).sum()

    def learned(self, camera: str) -> Learned:
        """The parameters of a camera. Without nodes, `response` and `changing` are empty."""
        values, count = self.params[camera], len(self.nodes)
        constant = len(values) - (1 + count if count else 0)
        return Learned(values[:constant], values[constant : constant + 1].flatten(), values[constant + 1 :])

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
            if len(own.changing):
                by_channel["response"] = settings.sigma_response * own.response
                factors = torch.exp(settings.sigma_gain * own.changing)
                figures[f"{camera}/factor_least"] = float(factors.min())
                figures[f"{camera}/factor_largest"] = float(factors.max())
            for name, values in by_channel.items():
                figures |= {f"{camera}/{name}_{c}": v for c, v in zip(CHANNELS, values.tolist(), strict=True)}
        return figures


def exposure_nodes(seconds: Sequence[float], interval: float | None) -> Float[Tensor, " k"]:
    """The times of nodes, about `interval` seconds apart, from the first to the last of the training images at
    `seconds`; none where exposures are constant (None) or the drive is shorter than half an interval."""
    if interval is None or not len(seconds):
        return torch.zeros(0)
    first, last = min(seconds), max(seconds)
    count = round((last - first) / interval) + 1
    return torch.linspace(first, last, count) if count > 1 else torch.zeros(0)
