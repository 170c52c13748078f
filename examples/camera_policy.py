"""A policy of the closed loop that sees images: a small network in torch, to be replaced by one of your own.

    runs:
      seen:
        policy: examples.camera_policy:CameraPolicy
        policy_settings: {weights: my_weights.pt}
        simulation: {cameras: [CAM_FRONT], width: 200}

docs/closed_loop.md says what a policy gets and gives. Without weights the network adds nothing: the vehicle keeps its
speed and follows the recorded path.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import nn

from drivesplat.simulate.policies import pursuit

WHEELBASE = 2.8
"""Metres."""


class CameraPolicy:
    """Adds what a network makes of the image, a steering angle (radians) and an acceleration (m/s²), to pure pursuit of
    the route."""

    def __init__(self, weights: str | None = None):
        """`weights` are those of `network()`, written by `torch.save(network.state_dict(), weights)`."""
        self._network = network().eval()
        if weights is not None:
            self._network.load_state_dict(torch.load(weights, weights_only=True, map_location="cpu"))

    @torch.no_grad()
    def act(self, observation: Mapping[str, Any], facts: Mapping[str, Any]) -> list[float]:
        """Steering and acceleration."""
        image = next(iter(observation["cameras"].values()))["rgb"]
        pixels = torch.from_numpy(image.copy()).permute(2, 0, 1)[None].float() / 255.0
        steering, push = self._network(pixels)[0].tolist()
        return [pursuit(observation["route"], float(observation["ego"][0]), WHEELBASE) + steering, push]


def network() -> nn.Module:
    """Images (n, 3, h, w) in [0, 1] to steering and acceleration (n, 2). The last layer begins at zero."""
    last = nn.Linear(32, 2)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    layers = [nn.Conv2d(3, 16, 5, 4), nn.ReLU(), nn.Conv2d(16, 32, 3, 2), nn.ReLU(), nn.AdaptiveAvgPool2d(1)]
    return nn.Sequential(*layers, nn.Flatten(), last)
