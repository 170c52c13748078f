"""LPIPS through the lpips package, its AlexNet backbone from a file."""

import warnings
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import torch

from drivesplat.errors import ResultError
from drivesplat.evaluation.metrics import LpipsMap
from drivesplat.io.storage import unreadable


def unavailable_or_map(record: dict[str, Any] | None, device: torch.device) -> tuple[str | None, LpipsMap | None]:
    """Why LPIPS cannot be measured and None, or None and the map. `record` is that of the stage `lpips_backbone`."""
    if record is None:
        return "lpips.enabled is false", None
    if record["unavailable"]:
        return record["unavailable"], None
    try:
        return None, lpips_map(Path(record["file"]), device)
    except ResultError as error:
        return str(error), None


def lpips_map(backbone: Path, device: torch.device) -> LpipsMap:
    """The function of two images (h, w, 3) in [0, 1] that gives their LPIPS (h, w).

    Raises ResultError where the backbone's file is missing or no AlexNet; it is read as tensors, nothing in it is
    executed.
    """
    import lpips  # with torchvision: seconds, for who measures it

    with warnings.catch_warnings():  # lpips calls torchvision and torch.load in ways they have deprecated
        warnings.simplefilter("ignore")
        network = lpips.LPIPS(net="alex", spatial=True, pnet_rand=True, verbose=False)
    load_alexnet(network.net, backbone)
    network = network.to(device).eval()
    alone = Lock()  # of threads that measure frames: the device has room for what the network makes of one

    @torch.no_grad()
    def distance(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
        with alone:
            pair = [torch.from_numpy(x).float().permute(2, 0, 1)[None].to(device) * 2.0 - 1.0 for x in (image, truth)]
            return network(*pair)[0, 0].cpu().numpy()

    return distance


def load_alexnet(network: torch.nn.Module, path: Path) -> None:
    """Puts torchvision's AlexNet weights (a file of `features.N.weight` and `.bias`) into lpips's slices of it."""
    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
        slices = {name: weights[f"features.{name.split('.', 1)[1]}"] for name in network.state_dict()}
        network.load_state_dict(slices)
    except Exception as error:  # a foreign file fails in torch, zip or pickle
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise unreadable(path, "lpips_backbone", f"not torchvision's AlexNet ({reason})") from error
