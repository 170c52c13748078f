"""`asset_harvester`: the folder that NVIDIA's Asset Harvester writes, with its metadata.yaml.

`{class}/{track}/gaussians.ply` has Gaussians without view-dependent colours, x right, y down, z forward, the origin at
the centre of the box, whose longest edge is one unit of length; metadata.yaml has {assets: {track: {ply_file,
label_class, cuboids_dims}}}, with length, width and height in metres. The frame follows from its cameras: those of
`lifting_inference.py` look along z at an object's back. Its `orient_gaussians_for_nurec.py` turns positions by -90
degrees about y and quaternions by +90 degrees, so that no rotation fits both; its files are refused by their extent.
"""

from pathlib import Path
from typing import Any

import yaml

from drivesplat.editing.assets.asset import Asset
from drivesplat.editing.assets.formats.foreign import ForeignAsset, box_of, file_inside, label_of, write_gaussians
from drivesplat.editing.assets.frames import AssetFrame
from drivesplat.errors import ResultError
from drivesplat.io.storage import atomic_write
from drivesplat.io.yaml_file import read_yaml

INDEX = "metadata.yaml"
FRAME = "z,-x,-y"


def recognises(path: Path) -> bool:
    return path.name == INDEX or (path / INDEX).is_file()


def find(path: Path) -> list[ForeignAsset]:
    """The assets of a folder, or of its metadata.yaml."""
    index = path if path.name == INDEX else path / INDEX
    found = []
    for track, record in _assets_of(index).items():
        if not isinstance(record, dict) or not {"ply_file", "label_class", "cuboids_dims"} <= record.keys():
            raise ResultError(f"{index}: the asset {track!r} lacks one of ply_file, label_class and cuboids_dims")
        size = box_of(index, record["cuboids_dims"], f"the asset {track!r}: cuboids_dims")
        file, frame = file_inside(index, record["ply_file"]), AssetFrame.parse(FRAME, float(size.max()))
        found.append(ForeignAsset(str(track), file, frame, str(record["label_class"]), size))
    return found


def write(folder: Path, name: str, asset: Asset, frame: AssetFrame) -> list[Path]:
    """Writes `{class}/{name}/gaussians.ply` and adds it to metadata.yaml; lengths are in units of the longest edge,
    unless the `frame` has a scale. Returns the files."""
    index, label = folder / INDEX, label_of(asset.object_class)
    assets = _assets_of(index) if index.is_file() else {}
    file = Path(label) / name / "gaussians.ply"
    own = frame if frame.scale != 1.0 else AssetFrame(frame.axes, float(asset.size.max()))
    write_gaussians(folder / file, asset, own, {"scale": own.scale})
    assets[name] = {"ply_file": file.as_posix(), "label_class": label, "cuboids_dims": asset.size.tolist()}
    with atomic_write(index) as stream:
        stream.write(yaml.safe_dump({"assets": assets}, sort_keys=False).encode())
    return [folder / file, index]


def _assets_of(index: Path) -> dict[Any, Any]:
    """The records of metadata.yaml by track. Raises ConfigError for a file that is no YAML, ResultError for one that
    lists no assets."""
    content = read_yaml(index, "index of assets")
    assets = content.get("assets") if isinstance(content, dict) else None
    if not isinstance(assets, dict) or not assets:
        raise ResultError(f"{index}: it lists no assets")
    return assets
