"""LPIPS (Zhang et al. 2018) by the lpips package, with its AlexNet backbone from a file."""

import warnings
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
import torch

from drivesplat.errors import ResultError
from drivesplat.evaluation.metrics import LpipsMap
from drivesplat.io.storage import unreadable


def load_lpips(record: dict[str, Any] | None, device: torch.device) -> tuple[str | None, LpipsMap | None]:
    """The reason why LPIPS is unavailable and None, or None and the map. `record` is that of `lpips_backbone`."""
    if record is None:
        return "lpips.enabled is false", None
    if record["unavailable"]:
        return record["unavailable"], None
    try:
        return None, lpips_map(Path(record["file"]), device)
    except ResultError as error:
        return str(error), None


def lpips_map(backbone: Path, device: torch.device) -> LpipsMap:
    """A function that maps two images (h, w, 3) in [0, 1] to their LPIPS per pixel (h, w).

    Raises ResultError if the backbone's file is missing or is no AlexNet. The file is read as tensors only; nothing in
    it is executed.
    """
    import lpips  # imports torchvision, which takes seconds

    with warnings.catch_warnings():  # lpips uses deprecated calls of torchvision and torch.load
        warnings.simplefilter("ignore")
        network = lpips.LPIPS(net="alex", spatial=True, pnet_rand=True, verbose=False)
    load_alexnet(network.net, backbone)
    network = network.to(device).eval()
    lock = Lock()  # the device has memory for one frame at a time

    @torch.no_grad()
    def distance(image: np.ndarray, truth: np.ndarray) -> np.ndarray:
        with lock:
            pair = [torch.from_numpy(x).float().permute(2, 0, 1)[None].to(device) * 2.0 - 1.0 for x in (image, truth)]
            return network(*pair)[0, 0].cpu().numpy()

    return distance


def load_alexnet(network: torch.nn.Module, path: Path) -> None:
    """Loads torchvision's AlexNet weights (`features.N.weight` and `.bias`) into the slices of lpips's network."""
    try:
        weights = torch.load(path, map_location="cpu", weights_only=True)
        slices = {name: weights[f"features.{name.split('.', 1)[1]}"] for name in network.state_dict()}
        network.load_state_dict(slices)
    except Exception as error:  # a foreign file may fail in torch, zip or pickle
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise unreadable(path, "lpips_backbone", f"not torchvision's AlexNet ({reason})") from error
