"""Learned corrections of camera poses: a small rigid transform per training image, in the camera's own frame."""

import dataclasses
import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from drivesplat.model.view import View
from drivesplat.settings.train_cameras import CameraPoseSettings

TIMES = "times_"
"""Prefix of the names of the buffers of times; the camera name follows."""


class CameraPoses(nn.Module):
    """Corrections for each camera of `times`, the increasing times (n,) of its training images in seconds. `params`
    hold (n, 6) numbers a camera, first those of shifts, initially 0; a number p is a correction of tanh(p) times its
    bound.

    corrected camera_to_world = camera_to_world @ correction. Numbers are linear in time between two training images and
    constant before the first and after the last. Cameras that are not listed are not corrected.
    """

    def __init__(self, times: Mapping[str, Sequence[float]], settings: CameraPoseSettings):
        super().__init__()
        self.params = nn.ParameterDict({camera: nn.Parameter(torch.zeros(len(at), 6)) for camera, at in times.items()})
        for camera, at in times.items():
            self.register_buffer(TIMES + camera, torch.tensor(at, dtype=torch.float64))
        self._times = {camera: tuple(at) for camera, at in times.items()}
        self._settings = settings
        bounds = [settings.max_shift] * 3 + [math.radians(settings.max_turn)] * 3
        self.register_buffer("bounds", torch.tensor(bounds), persistent=False)

    def corrected(self, view: View) -> View:
        """A view from its camera's corrected pose."""
        if view.camera not in self.params:
            return view
        moved = view.camera_to_world @ transform(self.bounds * torch.tanh(self._numbers(view.camera, view.time)))
        return dataclasses.replace(view, camera_to_world=moved)

    def penalty(self, camera: str | None) -> Float[Tensor, ""] | None:
        """The penalty of all corrections of a camera; None where there are none."""
        if camera not in self.params:
            return None
        parts = torch.tanh(self.params[camera])
        cost = self._settings.size_weight * parts.square().sum(dim=1).mean()
        if len(parts) > 2:
            bends = parts[:-2] - 2.0 * parts[1:-1] + parts[2:]
            cost = cost + self._settings.bend_weight * bends.square().sum(dim=1).mean()
        return cost

    def learning_rates(self) -> dict[str, float]:
        """The initial learning rate of every camera's entry of `params`."""
        return dict.fromkeys(self.params, self._settings.learning_rate)

    def figures(self) -> dict[str, float]:
        """The root mean square of every camera's shifts (metres) and turns (degrees). Waits for the device."""
        found = {}
        for camera, numbers in self.params.items():
            corrections = (self.bounds * torch.tanh(numbers.detach())).square()
            shift, turn = corrections[:, :3].sum(dim=1).mean().sqrt(), corrections[:, 3:].sum(dim=1).mean().sqrt()
            found |= {f"{camera}/shift_m": float(shift), f"{camera}/turn_deg": math.degrees(float(turn))}
        return found

    def _numbers(self, camera: str, time: float) -> Float[Tensor, "6"]:
        """A camera's numbers at a time. The time is known to Python: no host synchronisation."""
        times, numbers = self._times[camera], self.params[camera]
        after = bisect_right(times, time)
        if after == 0 or after == len(times):
            return numbers[min(after, len(times) - 1)]
        fraction = (time - times[after - 1]) / (times[after] - times[after - 1])
        return torch.lerp(numbers[after - 1], numbers[after], fraction)


def transform(correction: Float[Tensor, "6"]) -> Float[Tensor, "4 4"]:
    """The rigid transform of a shift and a small rotation vector v (radians), differentiable at 0: the normalised
    quaternion (1, v / 2), with an error of |v|³ / 12."""
    shift, vector = correction[:3], correction[3:]
    w, x, y, z = torch.nn.functional.normalize(torch.cat([vector.new_ones(1), 0.5 * vector]), dim=0)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), shift[0]]),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x), shift[1]]),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y), shift[2]]),
        torch.cat([torch.zeros_like(shift), shift.new_ones(1)]),
    ]
    return torch.stack(rows)
