"""How the colours of a picture differ from those recorded, on whichever device it is."""

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor

from drivesplat.kernels import triton as on_gpu
from drivesplat.training.ssim import C1, C2, ssim, weights
from drivesplat.training.views import TrainingView

if TYPE_CHECKING:
    from drivesplat.kernels.triton.colours import Window


@dataclass(frozen=True)
class ColourDifference:
    """Means over pixels and channels: the absolute difference, the structural similarity, and the absolute difference
    over what moves (None where nothing is known to)."""

    l1: Float[Tensor, ""]
    similarity: Float[Tensor, ""]
    moving_l1: Float[Tensor, ""] | None


def colour_difference(image: Float[Tensor, "h w 3"], view: TrainingView, of_moving: bool) -> ColourDifference:
    """What an image of a view differs by from the recorded one, with what moves where that is asked for.

    Where the own car's body is before it, it counts as recorded: nothing is pulled by these pixels. A window of SSIM
    that reaches over the body's edge finds both images alike beyond it and judges by the rest, and every other pixel
    weighs what it does in an image without a body. Were the recorded image made like the other instead, such windows
    would still pull on what lies behind the body.
    """
    moving = view.moving if of_moving else None
    if on_gpu.for_tensor(image):
        from drivesplat.kernels.triton import colours

        l1, similarity, moving_l1 = colours.colour_difference(
            image, view.pixels, view.own_car, moving, _window(image.device)
        )
        return ColourDifference(l1, similarity, None if moving is None else moving_l1)
    target = view.target()
    seen = image if view.own_car is None else torch.where(view.own_car[..., None], target, image)
    moving_l1 = None if moving is None else masked_l1(seen, target, moving)
    return ColourDifference(F.l1_loss(seen, target), ssim(seen, target), moving_l1)


def masked_l1(
    image: Float[Tensor, "h w 3"], target: Float[Tensor, "h w 3"], mask: Bool[Tensor, "h w"]
) -> Float[Tensor, ""]:
    """Mean absolute difference over a mask; 0 for an empty one."""
    difference = (image - target).abs().mean(dim=-1) * mask
    return difference.sum() / mask.sum().clamp(min=1)


@cache
def _window(device: torch.device) -> "Window":
    from drivesplat.kernels.triton.colours import Window

    return Window(torch.from_numpy(weights()).float().to(device), C1, C2)
