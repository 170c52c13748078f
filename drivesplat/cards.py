"""How many GPUs there are, without importing torch."""

import os
from pathlib import Path


def visible_cards() -> int:
    """How many GPUs this process may use, of any maker; never under 1, so that GPU rules can be scheduled on a CPU."""
    for variable in ("CUDA_VISIBLE_DEVICES", "HIP_VISIBLE_DEVICES", "ROCR_VISIBLE_DEVICES"):
        if variable in os.environ:
            return max(1, len([card for card in os.environ[variable].split(",") if card.strip() not in ("", "-1")]))
    nvidia = [p for p in Path("/dev").glob("nvidia[0-9]*") if p.name[6:].isdigit()]
    amd = [p for p in Path("/sys/class/kfd/kfd/topology/nodes").glob("*/gpu_id") if p.read_text().strip() != "0"]
    return max(1, len(nvidia) or len(amd))
