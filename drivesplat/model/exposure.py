"""Exposure and white balance of each camera: between the cameras of a rig, and over time."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from drivesplat.model.view import View
from drivesplat.settings.train import ExposureSettings

MIN_INTERVAL_S = 0.1
"""Smallest time between the nodes of exposures that change over time."""
CHANNELS = ("red", "green", "blue")
CHANGE_RATIO = 2.0
"""Expected size of log gains over their expected change within a second, a random walk."""


class GainCurve(NamedTuple):
    """Log gains (k, 3) of the colour channels of a camera at its k training images, at `seconds` (k,), of mean 0."""

    seconds: np.ndarray
    log_gains: np.ndarray

    @property
    def interval(self) -> float:
        """The usual time between two images."""
        return max(MIN_INTERVAL_S, float(np.median(np.diff(self.seconds))))

    def at(self, seconds: Float[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """The log gains at other times: linear between images, constant beyond them."""
        return np.stack([np.interp(seconds, self.seconds, values) for values in self.log_gains.T], axis=1)


class Exposures(nn.Module):
    """An affine map of every colour channel, by camera and time t: c becomes f exp(g + g(t)) c + o.

    `first` holds the initial gains f (3,) of the cameras with constants, and `curve` log gains (k, 3) at the nodes of
    cameras whose exposure changes, to which g(t) is added; both are estimated before the training. `params` is
    what is learned of each camera, (r, 3), in units of its expected size and initially 0: log gain g (row 0) and offset
    o (row 1), only of these cameras, then the log gains g(t) at the k times `nodes` (seconds). Between nodes g(t) is
    linear, beyond them constant.

    The reference camera has no constants: it fixes the brightness of the scene. Views without a camera have its curve
    alone, so that they look as images of that time do. Cameras without parameters keep the model's colours.
    """

    def __init__(
        self,
        first: Mapping[str, Tensor],
        settings: ExposureSettings,
        cameras: tuple[str, ...] = (),
        nodes: Float[Tensor, " k"] | None = None,
        curve: Mapping[str, Tensor] | None = None,
    ):
        """`cameras` without constants, besides those in `first`. Cameras with a `curve` are among both."""
        super().__init__()
        self.register_buffer("nodes", torch.zeros(0) if nodes is None else nodes.clone())
        self.first, self.curve = _fixed(first), _fixed(curve or {})
        rows = {
            **dict.fromkeys(first, 2 + len(self.nodes)),
            **dict.fromkeys(set(cameras) - set(first), len(self.nodes)),
        }
        self.params = nn.ParameterDict(
            {camera: nn.Parameter(torch.zeros(rows[camera], 3)) for camera in sorted(rows) if rows[camera]}
        )
        self._settings = settings
        self._reference = next((camera for camera in sorted(set(cameras) - set(first))), None)

    def applied(self, image: Float[Tensor, "h w 3"], view: View) -> Float[Tensor, "h w 3"]:
        """Maps an image from the model's colours to those of the view's camera at its time."""
        if view.camera is None and self._reference in self.curve:
            return image * torch.exp(self._log_gains(self.curve[self._reference], view.moment))
        if view.camera not in self.params:
            return image
        gains, offsets = self._map(view.camera, view.moment)
        return image * gains + offsets

    def penalty(self, camera: str | None) -> Float[Tensor, ""] | None:
        """The weighted mean square of a camera's constants, that of its log gains over time, and that of their
        changes; None without parameters or weight."""
        if camera not in self.params or not self._settings.weight:
            return None
        constants, changing = self._rows(camera)
        squares = [rows.square().mean() for rows in (constants, changing) if len(rows)]
        if len(changing) > 1:
            squares.append((CHANGE_RATIO * changing.diff(dim=0)).square().mean() / (self.nodes[1] - self.nodes[0]))
        return self._settings.weight * torch.stack(squares).sum()

    def _rows(self, camera: str) -> tuple[Float[Tensor, "c 3"], Float[Tensor, "k 3"]]:
        """The parameters of a camera that are constant, and those over time."""
        own, changing = self.params[camera], len(self.nodes)
        constant = len(own) - changing
        return own[:constant], own[constant:]

    def _map(self, camera: str, seconds: Float[Tensor, ""]) -> tuple[Tensor, Tensor | float]:
        """Gains (3,) and offsets (3,) or 0 of a camera at a time."""
        constants, changing = self._rows(camera)
        log_gains, offsets = self._log_gains(changing, seconds), 0.0
        if len(constants):
            log_gains, offsets = log_gains + constants[0], self._settings.sigma_offset * constants[1]
        log_gains = self._settings.sigma_gain * log_gains
        if camera in self.curve:
            log_gains = log_gains + self._log_gains(self.curve[camera], seconds)
        gains = torch.exp(log_gains)
        return (gains * self.first[camera] if len(constants) else gains), offsets

    def _log_gains(self, changing: Float[Tensor, "k 3"], seconds: Float[Tensor, ""]) -> Float[Tensor, "3"]:
        """The log gains over time between those at the nodes."""
        if not len(changing):
            return changing.new_zeros(3)
        within = torch.minimum(torch.maximum(seconds, self.nodes[0]), self.nodes[-1])
        weights = 1.0 - (within - self.nodes).abs() / (self.nodes[1] - self.nodes[0])
        return weights.clamp(min=0.0) @ changing

    @torch.no_grad()
    def take_over(self, other: "Exposures", seconds: float) -> None:
        """Starts from other exposures of the same cameras, to whose times `seconds` are added."""
        for camera in self.params.keys() & other.params.keys():
            (constants, changing), (others, others_changing) = self._rows(camera), other._rows(camera)
            if len(constants) == len(others):
                constants.copy_(others)
                if camera in self.first:
                    self.first[camera].copy_(other.first[camera])
            for row, node in zip(changing, self.nodes - seconds, strict=True):
                row.copy_(other._log_gains(others_changing, node))
            self._continue_curve(other, camera, seconds)

    def _continue_curve(self, other: "Exposures", camera: str, seconds: float) -> None:
        """Shifts a camera's curve by what it differs from that of other exposures at the times of both, where the
        scene has the same colours."""
        if camera not in self.curve and camera not in other.curve:
            return
        nothing = self.nodes.new_zeros(len(self.nodes), 3)
        own, times = self.curve.get(camera, nothing), self.nodes - seconds
        others = other.curve.get(camera, other.nodes.new_zeros(len(other.nodes), 3))
        common = times[(times >= other.nodes[0]) & (times <= other.nodes[-1])]
        common = common if len(common) else times[:1]
        shifts = [other._log_gains(others, at) - self._log_gains(own, at + seconds) for at in common]
        self.curve[camera] = nn.Parameter(own + torch.stack(shifts).mean(dim=0), requires_grad=False)

    def learning_rates(self) -> dict[str, float]:
        """The initial learning rate of every camera's entry of `params`."""
        return dict.fromkeys(self.params, self._settings.learning_rate)

    @torch.no_grad()
    def figures(self) -> dict[str, float]:
        """By name, constant gains and offsets ('CAM_BACK/gain_red'), and the smallest and the largest factor of any
        channel over time ('CAM_BACK/factor_least', 'CAM_BACK/factor_largest'). Waits for the device."""
        figures = {}
        for camera in self.params:
            constants, changing = self._rows(camera)
            if len(constants):
                gains = self.first[camera] * torch.exp(self._settings.sigma_gain * constants[0])
                found = zip(("gain", "offset"), (gains, self._settings.sigma_offset * constants[1]), strict=True)
                figures |= {
                    f"{camera}/{n}_{c}": v for n, own in found for c, v in zip(CHANNELS, own.tolist(), strict=True)
                }
            if len(changing):
                known = self.curve.get(camera, 0.0)
                factors = torch.exp(self._settings.sigma_gain * changing + known)
                figures |= {
                    f"{camera}/factor_least": float(factors.min()),
                    f"{camera}/factor_largest": float(factors.max()),
                }
        return figures


def _fixed(values: Mapping[str, Tensor]) -> nn.ParameterDict:
    """Copies of what is known of cameras, which is not learned."""
    return nn.ParameterDict({camera: nn.Parameter(own.clone(), requires_grad=False) for camera, own in values.items()})


def exposure_nodes(seconds: Sequence[float], interval: float | None) -> Float[Tensor, " k"]:
    """The times of nodes, about `interval` seconds apart, from the first to the last of the training images at
    `seconds`; none where exposures are constant (None) or the drive is shorter than half an interval."""
    if interval is None or not len(seconds):
        return torch.zeros(0)
    first, last = min(seconds), max(seconds)
    count = round((last - first) / interval) + 1
    return torch.linspace(first, last, count) if count > 1 else torch.zeros(0)
