"""`splatsim`: a bank of actors of SplatSim, actor_assets.json of the schema `splatsim.actor_assets/v1`.

Its object frame is that of drivesplat (x forward, y left, z up, metres, the origin at the centre of the box), so that
Gaussians fit unturned. Quaternions of its JSON files are x, y, z, w; those of PLY files are w, x, y, z, as everywhere.
SplatSim itself keeps Gaussians as SPZ; here they are `parts/{asset}.ply`.
"""

from pathlib import Path
from typing import Any

from drivesplat.editing.assets.asset import Asset
from drivesplat.editing.assets.formats.foreign import (
    ForeignAsset,
    box_of,
    file_inside,
    json_of,
    label_of,
    write_gaussians,
)
from drivesplat.editing.assets.frames import AssetFrame
from drivesplat.errors import ResultError
from drivesplat.io.storage import write_json

INDEX, SCHEMA = "actor_assets.json", "splatsim.actor_assets/v1"
FRAME = "x,y,z"
OBJECT_FRAME = {
    "handedness": "right",
    "forward": "+x",
    "left": "+y",
    "up": "+z",
    "origin": "bbox_center",
    "quaternion_order": "xyzw",
    "length_units": "meters",
    "scale": "metric",
}


def recognises(path: Path) -> bool:
    return path.name == INDEX or (path / INDEX).is_file()


def find(path: Path) -> list[ForeignAsset]:
    """The assets of a folder, or of its actor_assets.json."""
    index = path if path.name == INDEX else path / INDEX
    found = []
    for record in _bank(index)["assets"]:
        if not isinstance(record, dict) or not {"asset_id", "uri", "class_name", "size"} <= record.keys():
            raise ResultError(f"{index}: an asset lacks one of asset_id, uri, class_name and size")
        name = str(record["asset_id"])
        if record.get("motion", "rigid") != "rigid":
            raise ResultError(f"{index}: the motion of the asset {name!r} is {record['motion']!r}, not 'rigid'")
        if str(record["uri"]).endswith(".spz"):
            raise ResultError(
                f"{index}: the Gaussians of the asset {name!r} are SPZ, which is not read; name a PLY file as its uri"
            )
        size = box_of(index, record["size"], f"the asset {name!r}: size")
        file, frame = file_inside(index, record["uri"]), AssetFrame.parse(FRAME)
        found.append(ForeignAsset(name, file, frame, str(record["class_name"]), size))
    return found


def write(folder: Path, name: str, asset: Asset, frame: AssetFrame) -> list[Path]:
    """Writes `parts/{name}.ply` and adds it to actor_assets.json. Returns the files."""
    index, file = folder / INDEX, Path("parts") / f"{name}.ply"
    bank = _bank(index) if index.is_file() else {"assets": [], "instances": []}
    means = asset.gaussians.means
    record = {
        "asset_id": name,
        "uri": file.as_posix(),
        "class_name": label_of(asset.object_class),
        "motion": "rigid",
        "size": asset.size.tolist(),
        "bbox_min": means.amin(dim=0).tolist(),
        "bbox_max": means.amax(dim=0).tolist(),
        "n_points": len(asset.gaussians),
        "sh_degree": asset.gaussians.sh_degree,
        "provenance": {"source": dict(asset.source)},
        "metadata": {},
    }
    write_gaussians(folder / file, asset, frame, {})
    others = [own for own in bank["assets"] if not isinstance(own, dict) or own.get("asset_id") != name]
    head = {"schema": SCHEMA, "frame": "object", "object_frame": OBJECT_FRAME}
    write_json(index, {**head, "assets": [*others, record], "instances": bank.get("instances") or []})
    return [folder / file, index]


def _bank(index: Path) -> dict[str, Any]:
    """The content of actor_assets.json. Raises ResultError for a file that is none of this schema and frame."""
    content = json_of(index)
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA:
        raise ResultError(f"{index}: its schema is {schema!r}, not {SCHEMA!r}")
    if content.get("frame") != "object" or content.get("object_frame") != OBJECT_FRAME:
        raise ResultError(f"{index}: it does not declare the object frame of {SCHEMA}")
    if not isinstance(content.get("assets"), list) or not content["assets"]:
        raise ResultError(f"{index}: it lists no assets")
    return content
