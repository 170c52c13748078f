"""What a metrics.json says, in sentences: `python -m drivesplat.evaluation.in_words results/demo/metrics.json`."""

import sys
from pathlib import Path
from typing import Any

from drivesplat.errors import DriveSplatError
from drivesplat.storage import read_json

BETWEEN = {"interpolation": "between training frames", "extrapolation": "beyond the last training frame"}


def in_words(metrics: dict[str, Any], path: str | Path) -> list[str]:
    """A sentence per method and group of held-out frames, and one that says where to look."""
    lines = []
    for name, method in metrics["methods"].items():
        for group, where in BETWEEN.items():
            static, gap = (method[group].get(key) for key in ("static", "gap_db"))
            if static and static.get("psnr") is not None:
                lines.append(f"{name}, frames {where}: static {static['psnr']:.1f} dB, {_movers(method[group], gap)}")
        seconds, device = method["train_seconds"], method["device"]
        lines.append(f"{name}: {method['gaussians']:,} Gaussians, trained in {seconds:.0f} s on {device}")
    folder = Path(path).parent
    lines.append(f"All figures: {path}; training curves and pictures: tensorboard --logdir {folder}")
    return lines


def _movers(group: dict[str, Any], gap: float | None) -> str:
    moving = group.get("moving_vehicle")
    if gap is None or not moving or moving.get("psnr") is None:
        return "no moving vehicle to compare with"
    return f"moving vehicles {moving['psnr']:.1f} dB: a gap of {gap:.1f} dB"


if __name__ == "__main__":
    try:
        print("\n".join(in_words(read_json(sys.argv[1], rule="scene_metrics"), sys.argv[1])))
    except DriveSplatError as error:
        sys.exit(f"drivesplat: {error}")
