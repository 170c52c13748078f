"""Assets of other programs become assets of a library, and assets become files of other programs.

options = ImportOptions(frame="z,-x,-y", scale=1.0, object_class="car")
names = import_assets(Path("car.ply"), Path("library"), options)
files = export_assets([Path("library") / names[0]], "splatsim", Path("out"))
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

import numpy as np
import torch

from drivesplat.editing.assets.asset import MAX_GAUSSIANS, Asset, read_asset, read_gaussians, size_fault
from drivesplat.editing.assets.asset_library import AssetLibrary, library_name
from drivesplat.editing.assets.formats import asset_harvester, hugsim, plain_ply, splatsim
from drivesplat.editing.assets.formats.foreign import ForeignAsset, class_of
from drivesplat.editing.assets.frames import AssetFrame, extent_of, misfit
from drivesplat.errors import RequestError, ResultError
from drivesplat.io.point_cloud import MAX_HEADER_BYTES
from drivesplat.io.regular_file import regular_file
from drivesplat.io.storage import no_provenance, sha256_file
from drivesplat.model.gaussians import Gaussians
from drivesplat.scene.object_class import ObjectClass

FORMATS: dict[str, ModuleType] = {
    "asset_harvester": asset_harvester,
    "splatsim": splatsim,
    "hugsim": hugsim,
    "ply": plain_ply,
}
"""The modules of formats by name, in the order in which they are asked whether a path is of theirs."""
ORIGINS = ("box", "file")
MAX_SH_DEGREE = 3
COUNT = re.compile(rb"element +vertex +(\d+)")


@dataclass(frozen=True)
class ImportOptions:
    """What to know of assets besides their files; None: as the files and the format declare it.

    `frame` are the axes of forward, left and up (`AssetFrame.parse`), `scale` metres per unit of length. `origin` is
    `file` where the origin of the file is the centre of the box, and `box` where the origin is to be moved to the
    middle of the Gaussians. `size` are length, width and height of the box in metres, `name` the name in the library.
    """

    format: str | None = None
    frame: str | None = None
    scale: float | None = None
    origin: str | None = None
    object_class: str | None = None
    size: tuple[float, float, float] | None = None
    name: str | None = None


def import_assets(path: Path, folder: Path, options: ImportOptions) -> list[str]:
    """Reads the assets of another program from a file or folder and adds them to the library in `folder`. Returns their
    names there.

    Raises RequestError for options that are absent or do not fit, ResultError for files that are not of the format.
    """
    if not path.exists():
        raise ResultError(f"there is no {path}")
    named = options.format or _format_of(path)
    if named not in FORMATS:
        raise RequestError(f"there is no format {named!r}; known are {', '.join(FORMATS)}")
    found = FORMATS[named].find(path)
    if len(found) > 1 and (options.name or options.size):
        raise RequestError(f"{path} has {len(found)} assets: a name and a size can be given for one alone")
    library, names = AssetLibrary(folder), []
    try:
        for own in found:
            asset = converted(own, named, options)
            library.add(asset.name, asset)
            names.append(asset.name)
    finally:
        if names:
            library.write_index()
    return names


def converted(found: ForeignAsset, named: str, options: ImportOptions) -> Asset:
    """The asset of another program, of the format `named`, as an asset in the frame of its object. What no file says of
    it is unknown: from where it was seen, the ground, the gait; without columns of drivesplat also LiDAR logits."""
    frame = _frame(found, options)
    word = options.object_class or found.label
    if word is None:
        raise RequestError(f"{found.file}: the file does not say what it is: give the class, such as --class car")
    object_class = class_of(word)
    if object_class is None:
        known = ", ".join(ObjectClass)
        raise RequestError(f"{found.file}: the class {word!r} is unknown: give one of {known} with --class")
    own, invented = _usable_gaussians(found.file)
    gaussians = frame.to_object(own)
    middle, extent = extent_of(gaussians)
    if (options.origin or ("file" if found.centred else "box")) == "box":
        gaussians = replace(gaussians, means=gaussians.means - torch.from_numpy(middle).float())
    size = np.array(options.size, dtype=np.float64) if options.size else extent if found.size is None else found.size
    if fault := size_fault(object_class, size) or misfit(gaussians, size):
        raise ResultError(f"{found.file}: {fault}")
    digest = sha256_file(found.file)
    told = {"frame": frame.words, "scale": frame.scale, "file": found.file.name, "sha256": digest}
    return Asset(
        name=library_name(options.name or found.name),
        object_class=object_class,
        category=found.label or object_class.value,
        size=size,
        gaussians=gaussians,
        invented=invented,
        source={"format": named, "asset": found.name, "file": found.file.name, "sha256": digest},
        provenance={**no_provenance(), "import": {"format": named, **told}},
    )


def export_assets(
    folders: Sequence[Path], named: str, out: Path, frame: str | None = None, scale: float | None = None
) -> list[Path]:
    """Writes the assets of some folders as files of another format into the folder `out`, beside those that are there.
    `frame` and `scale` are those of the format, unless given. Returns the files.

    Raises RequestError for an unknown format or frame, ResultError for a folder that is none of an asset.
    """
    if named not in FORMATS:
        raise RequestError(f"there is no format {named!r}; known are {', '.join(FORMATS)}")
    module = FORMATS[named]
    target, files = AssetFrame.parse(frame or module.FRAME, 1.0 if scale is None else scale), []
    for folder in folders:
        asset = read_asset(folder)
        files += module.write(out, library_name(asset.name), asset, target)
    return list(dict.fromkeys(files))


def _format_of(path: Path) -> str:
    named = next((name for name, module in FORMATS.items() if module.recognises(path)), None)
    if named is None:
        raise ResultError(
            f"{path} is of no known format ({', '.join(FORMATS)}): it has neither metadata.yaml nor actor_assets.json "
            "nor wlh.json, and is no PLY file"
        )
    return named


def _frame(found: ForeignAsset, options: ImportOptions) -> AssetFrame:
    """The declared frame of an asset. Raises RequestError where nothing declares one."""
    if options.origin not in (None, *ORIGINS):
        raise RequestError(f"the origin {options.origin!r} is neither of {' and '.join(ORIGINS)}")
    own = found.frame
    words = options.frame or (own.words if own else None)
    scale = options.scale if options.scale is not None or own is None else own.scale
    if words is None or scale is None:
        raise RequestError(
            f"{found.file}: the file declares no frame: give the axes of forward, left and up and the metres per unit, "
            "such as --frame x,y,z --scale 1"
        )
    return AssetFrame.parse(words, scale)


def _usable_gaussians(path: Path) -> tuple[Gaussians, torch.Tensor]:
    """The Gaussians of a file, and which are invented. Raises ResultError for a file that cannot be an asset."""
    try:
        with open(regular_file(path), "rb") as file:
            counted = COUNT.search(file.read(MAX_HEADER_BYTES))
    except OSError as error:
        raise ResultError(f"{path}: cannot be read ({error.strerror or error})") from error
    if counted and int(counted[1]) > MAX_GAUSSIANS:
        raise ResultError(f"{path}: it has {int(counted[1]):,} Gaussians; an asset has 1 to {MAX_GAUSSIANS:,}")
    gaussians, invented = read_gaussians(path)
    if gaussians.sh_degree > MAX_SH_DEGREE:
        raise ResultError(f"{path}: its colours have degree {gaussians.sh_degree}; at most {MAX_SH_DEGREE} is read")
    if not bool(gaussians.quats.norm(dim=1).gt(1e-8).all()) or not bool(torch.isfinite(gaussians.scales).all()):
        raise ResultError(f"{path}: some of its Gaussians have no rotation or an infinite scale")
    return gaussians, invented
