"""`ply`: the Gaussians of one object as a file of 3D Gaussian Splatting, which declares neither frame nor class."""

from pathlib import Path

from drivesplat.editing.assets.asset import Asset
from drivesplat.editing.assets.formats.foreign import ForeignAsset, write_gaussians
from drivesplat.editing.assets.frames import AssetFrame
from drivesplat.errors import ResultError

FRAME = "x,y,z"


def recognises(path: Path) -> bool:
    return path.suffix == ".ply"


def find(path: Path) -> list[ForeignAsset]:
    """The asset of a file, whose origin is anywhere."""
    if not path.is_file():
        raise ResultError(f"{path} is not a PLY file")
    return [ForeignAsset(path.stem, path, centred=False)]


def write(folder: Path, name: str, asset: Asset, frame: AssetFrame) -> list[Path]:
    """Writes `{name}.ply`, whose note has the size of the box in metres. Returns the files."""
    write_gaussians(folder / f"{name}.ply", asset, frame, {"scale": frame.scale, "size": asset.size.tolist()})
    return [folder / f"{name}.ply"]
