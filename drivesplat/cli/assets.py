"""The command `drivesplat assets`: a library of assets, and assets of and for other programs.

drivesplat assets results/ --out library/
drivesplat assets import car.ply --out library/ --frame z,-x,-y --scale 1 --class car
drivesplat assets export library/car --format splatsim --out bank/
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

COMMAND, DEFAULT = "assets", "collect"
ACTIONS = (DEFAULT, "import", "export")
FORMATS = ("ply", "asset_harvester", "splatsim", "hugsim")


def add_parser(commands: Any) -> None:
    """Adds the command to the sub-parsers of `drivesplat`."""
    parser = commands.add_parser(
        COMMAND, help="collect assets in a library, import and export them: assets results/ --out library/"
    )
    actions = parser.add_subparsers(required=True, dest="action", metavar="|".join(ACTIONS))

    collect = actions.add_parser(DEFAULT, help="copy the assets of all scenes and methods into a library (the default)")
    collect.add_argument("results", type=Path, help="folder of the results")
    collect.add_argument("--out", type=Path, required=True, help="folder of the library")
    collect.add_argument(
        "--class", dest="classes", action="append", default=[], metavar="CLASS", help="of this class alone; repeatable"
    )
    collect.add_argument("--min-psnr", type=float, metavar="DB", help="of at least this PSNR in held-out images")

    add = actions.add_parser("import", help="add an asset of another program to a library")
    add.add_argument("path", type=Path, help="a file or folder of the other program")
    add.add_argument("--out", type=Path, required=True, help="folder of the library")
    add.add_argument("--format", choices=FORMATS, help="by default as the files tell")
    add.add_argument("--class", dest="object_class", metavar="CLASS", help="what it is, such as car")
    add.add_argument("--size", type=float, nargs=3, metavar=("L", "W", "H"), help="of the box in metres")
    add.add_argument("--origin", choices=["box", "file"], help="move the origin to the middle of the Gaussians, or not")
    add.add_argument("--name", help="its name in the library")
    _add_frame(add)

    write = actions.add_parser("export", help="write assets as files of another program")
    write.add_argument("folders", type=Path, nargs="+", metavar="ASSET", help="folder of an asset, such as library/ID")
    write.add_argument("--format", required=True, choices=FORMATS)
    write.add_argument("--out", type=Path, required=True, help="folder to write into")
    _add_frame(write)


def _add_frame(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--frame", metavar="AXES", help="the axes of forward, left and up: x,y,z or z,-x,-y or --frame=-x,-y,z"
    )
    parser.add_argument("--scale", type=float, metavar="METRES", help="metres per unit of length")


def with_action(given: Sequence[str]) -> list[str]:
    """The arguments of `drivesplat` with the default action of the command `assets` where none is named."""
    if given[:1] == [COMMAND] and given[1:] and given[1] not in (*ACTIONS, "-h", "--help"):
        return [COMMAND, DEFAULT, *given[1:]]
    return list(given)


def run_assets(parsed: argparse.Namespace) -> int:
    """Runs the command with its parsed arguments. Returns the exit status."""
    if parsed.action == DEFAULT:
        from drivesplat.editing.assets.collection import collect_assets

        collected = collect_assets(parsed.results, parsed.out, parsed.classes, parsed.min_psnr)
        print(f"{collected.words}; {parsed.out / 'index.html'} shows them")
        return 0
    from drivesplat.editing.assets.exchange import ImportOptions, export_assets, import_assets

    if parsed.action == "import":
        options = ImportOptions(
            format=parsed.format,
            frame=parsed.frame,
            scale=parsed.scale,
            origin=parsed.origin,
            object_class=parsed.object_class,
            size=tuple(parsed.size) if parsed.size else None,
            name=parsed.name,
        )
        names = import_assets(parsed.path, parsed.out, options)
        print(f"added to {parsed.out}: {', '.join(names)}; {parsed.out / 'index.html'} shows them")
    else:
        files = export_assets(parsed.folders, parsed.format, parsed.out, parsed.frame, parsed.scale)
        print("\n".join(map(str, files)))
    return 0
