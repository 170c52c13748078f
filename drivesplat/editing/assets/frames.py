"""Coordinate frames of assets of other programs, and Gaussians from one into the other.

An asset of drivesplat is in the frame of its object: x forward, y left, z up, metres, the origin at the centre of its
box. A rotation turns means, quaternions, spherical harmonics and LiDAR logits alike.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch.nn.functional import normalize

from drivesplat.errors import RequestError
from drivesplat.kernels.quaternions import left_factor, rotation_matrix
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.harmonics import rotated

AXES = {sign + "xyz"[i]: value * np.eye(3)[i] for i in range(3) for sign, value in (("", 1.0), ("-", -1.0))}
OPAQUE, OUTSIDE = 0.1, 0.01
"""The extent of an asset is that of its Gaussians of at least this opacity, but for this fraction at either end."""
MAX_EXCESS, MIN_FILLED, MAX_OFFSET = 1.8, 0.4, 0.4
"""Gaussians fit a box if they extend over at most so many times its edges and over so much of one of them, and if their
middle is at most so much of its height above or below its centre."""


@dataclass(frozen=True, eq=False)
class AssetFrame:
    """The frame of a file: the rows of `axes` are the directions forward, left and up of the object in the file's
    coordinates, and `scale` is metres per unit of length."""

    axes: Float[np.ndarray, "3 3"]
    scale: float = 1.0

    @classmethod
    def parse(cls, words: str, scale: float = 1.0) -> "AssetFrame":
        """The frame whose directions forward, left and up are the axes in `words`, such as `x,y,z` (the frame of
        drivesplat) or `z,-x,-y` (x right, y down, z forward).

        Raises RequestError for words that are no axes, and for a frame that is mirrored or not orthogonal.
        """
        names = words.replace(" ", "").split(",")
        if len(names) != 3 or not set(names) <= AXES.keys():
            raise RequestError(
                f"the frame {words!r} is not three axes: give those of forward, left and up, such as z,-x,-y"
            )
        axes = np.stack([AXES[name] for name in names])
        if np.linalg.matrix_rank(axes) < 3:
            raise RequestError(f"the frame {words!r} is not orthogonal: forward, left and up need an axis each")
        if np.linalg.det(axes) < 0.0:
            raise RequestError(
                f"the frame {words!r} is mirrored: forward, left and up are not right-handed; check the sign of one"
            )
        if not (np.isfinite(scale) and scale > 0.0):
            raise RequestError(f"the scale {scale:g} is not a number of metres per unit above 0")
        return cls(axes, float(scale))

    @property
    def words(self) -> str:
        """Its axes as `parse` reads them."""
        return ",".join(next(name for name, axis in AXES.items() if np.array_equal(axis, own)) for own in self.axes)

    def to_object(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians of a file in the object's frame, without a change of the origin."""
        return moved(gaussians, self.axes, self.scale)

    def from_object(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians in the object's frame as a file in this frame has them."""
        return moved(gaussians, self.axes.T, 1.0 / self.scale)


def moved(gaussians: Gaussians, rotation: Float[np.ndarray, "3 3"], scale: float) -> Gaussians:
    """Gaussians rotated by `rotation` (old to new coordinates) and scaled, with their colours and LiDAR logits by
    direction. Computed in float64; quaternions come out as unit quaternions."""
    turn = torch.from_numpy(np.ascontiguousarray(rotation, dtype=np.float64))
    quat = torch.from_numpy(Rotation.from_matrix(rotation).as_quat(scalar_first=True))
    tensors = {name: values.double() for name, values in gaussians.tensors.items()}
    sh = rotated(gaussians.sh.double(), turn)
    changed = {
        "means": scale * (tensors["means"] @ turn.T),
        "quats": normalize(tensors["quats"] @ left_factor(quat).T, dim=-1),
        "scales": scale * tensors["scales"],
        "sh0": sh[:, :1],
        "shN": sh[:, 1:],
    }
    if "lidar_logits" in tensors:
        constant, linear = tensors["lidar_logits"][:, :1], tensors["lidar_logits"][:, 1:]
        changed["lidar_logits"] = torch.cat([constant, turn @ linear], dim=1)
    return Gaussians(**{name: values.float() for name, values in {**tensors, **changed}.items()})


def extent_of(gaussians: Gaussians) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """The middle and the size of the box with faces along the axes in which opaque Gaussians are, with one standard
    deviation around each."""
    opaque = gaussians.opacities >= OPAQUE
    chosen = gaussians[opaque] if bool(opaque.any()) else gaussians
    axes = rotation_matrix(normalize(chosen.quats.double(), dim=-1)) * chosen.scales.double()[:, None]
    means, spread = chosen.means.double().numpy(), axes.square().sum(dim=2).sqrt().numpy()
    low = np.quantile(means - spread, OUTSIDE, axis=0)
    high = np.quantile(means + spread, 1.0 - OUTSIDE, axis=0)
    return (low + high) / 2.0, high - low


def misfit(gaussians: Gaussians, size: Float[np.ndarray, "3"]) -> str | None:
    """Why Gaussians in the object's frame are not those of a box of this size (metres); None where they are."""
    middle, extent = extent_of(gaussians)
    if (extent > MAX_EXCESS * size).any() or (extent < MIN_FILLED * size).all():
        own, box = (" x ".join(f"{edge:.3g}" for edge in edges) for edges in (extent, size))
        return (
            f"its Gaussians extend over {own} m (length, width, height), which does not fit its box of {box} m: check "
            "the frame, the scale and the size"
        )
    if abs(middle[2]) > MAX_OFFSET * size[2]:
        return (
            f"the middle of its Gaussians is {middle[2]:.2f} m above the origin, which is not the centre of its box: "
            "import it with --origin box"
        )
    return None
