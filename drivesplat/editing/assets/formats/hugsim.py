"""`hugsim`: cars of HUGSIM, made from 3DRealCar, as its converter writes them.

`{car}/wlh.json` has width, length and height in metres, and `{car}/{car}.ply` or `converted/{car}.ply` the Gaussians:
y down, and x forward, since a car at yaw 0 stands turned by -90 degrees about y in a world whose z is forward
(`sim/utils/plan.py`). HUGSIM itself reads gs.pth, a pickle that could execute anything: it is not read here.
"""

from pathlib import Path

from drivesplat.editing.assets.asset import Asset
from drivesplat.editing.assets.formats.foreign import ForeignAsset, box_of, json_of, write_gaussians
from drivesplat.editing.assets.frames import AssetFrame
from drivesplat.errors import ResultError
from drivesplat.io.storage import write_json

SIZE, PICKLE, CONVERTED = "wlh.json", "gs.pth", "converted"
FRAME = "x,z,-y"
LABEL = "car"


def recognises(path: Path) -> bool:
    return path.suffix == ".pth" or (path / SIZE).is_file() or any(path.glob(f"*/{SIZE}"))


def find(path: Path) -> list[ForeignAsset]:
    """The car of a folder or of a PLY file beside wlh.json, or the cars of the folders in a folder."""
    if path.suffix == ".pth":
        raise _pickled(path)
    if path.is_file():
        return [_car(path.stem, path, path.with_name(SIZE))]
    if (path / SIZE).is_file():
        return [_car(path.name, _file_of(path), path / SIZE)]
    cars = sorted(size.parent for size in path.glob(f"*/{SIZE}"))
    if not cars:
        raise ResultError(f"{path}: no folder of a car with {SIZE}")
    return [_car(car.name, _file_of(car), car / SIZE) for car in cars]


def write(folder: Path, name: str, asset: Asset, frame: AssetFrame) -> list[Path]:
    """Writes `{name}/{name}.ply` and `{name}/wlh.json`. Returns the files."""
    file, size = folder / name / f"{name}.ply", folder / name / SIZE
    write_gaussians(file, asset, frame, {})
    length, width, height = asset.size.tolist()
    write_json(size, [width, length, height])
    return [file, size]


def _car(name: str, file: Path, size: Path) -> ForeignAsset:
    width, length, height = box_of(size, json_of(size), "the size")
    return ForeignAsset(name, file, AssetFrame.parse(FRAME), LABEL, box_of(size, [length, width, height], "the size"))


def _file_of(car: Path) -> Path:
    """The PLY of a car's folder. Raises ResultError where there is none, or more than one."""
    converted = car.parent / CONVERTED / f"{car.name}.ply"
    files = [converted] if converted.is_file() else sorted(car.glob("*.ply"))
    if len(files) == 1:
        return files[0]
    if not files and (car / PICKLE).is_file():
        raise _pickled(car / PICKLE)
    raise ResultError(f"{car}: it has {len(files)} PLY files; a car has one")


def _pickled(path: Path) -> ResultError:
    return ResultError(
        f"{path} is a pickle, which could execute anything and is not read: convert it with HUGSIM's "
        "eval_render/convert_vehicles.py and import the PLY that this writes"
    )
