"""`python -m drivesplat.readers.drive`: checks a drive folder, prints the schema of drive.json, or writes a folder."""

import argparse
import json
import sys
import tempfile
from pathlib import Path

from drivesplat.errors import DatasetError, DriveSplatError
from drivesplat.io.standard_output import standard_output
from drivesplat.preprocess.intrinsics import intrinsics_warnings
from drivesplat.preprocess.undistort import distortion_fault, undistorted
from drivesplat.readers.drive.check import examine, summary
from drivesplat.readers.drive.format import Drive, grouped
from drivesplat.readers.drive.layout import outline
from drivesplat.readers.drive.needed_settings import needed_settings
from drivesplat.readers.drive.nerfstudio import add_command
from drivesplat.readers.drive.sweep_file import columns_sentence
from drivesplat.readers.drive.write import write_drive
from drivesplat.readers.drive_warnings import drive_warnings
from drivesplat.readers.record_names import counted
from drivesplat.scene.scene import UNPOSED, Scene, read_scene
from drivesplat.settings.method import default_methods
from drivesplat.settings.without_boxes import DRIFTING, HOW, REPLACED, reason, substitute


def main(arguments: list[str] | None = None) -> int:
    """Runs a command; returns the exit status, 1 where a folder has faults."""
    parser = argparse.ArgumentParser(prog="python -m drivesplat.readers.drive", description=__doc__)
    commands = parser.add_subparsers(required=True)
    checking = commands.add_parser("check", help="list every fault of a drive folder, and draw a picture")
    checking.add_argument("folder", type=Path)
    checking.add_argument("--picture", type=Path, help="where the picture is written; by default {folder}/check.png")
    checking.set_defaults(run=lambda asked: run_check(asked.folder, asked.picture))
    schema = commands.add_parser("schema", help="print the JSON schema of drive.json")
    schema.set_defaults(run=lambda _: print(json.dumps(Drive.model_json_schema(by_alias=True), indent=2)))
    writing = commands.add_parser("write", help="write an extracted scene as a drive folder")
    writing.add_argument("scene", type=Path, help="a scene.json, such as results/0061/scene.json")
    writing.add_argument("folder", type=Path)
    writing.add_argument("--licence", default="", help="who may use the recording, and for what")
    writing.set_defaults(run=lambda asked: print(write_drive(read_scene(asked.scene), asked.folder, asked.licence)))
    add_command(commands)
    asked = parser.parse_args(arguments)
    try:
        with standard_output():
            return asked.run(asked) or 0
        return 0  # nobody reads the rest
    except DriveSplatError as error:
        print(f"drivesplat: {error}", file=sys.stderr)
        return 1


def run_check(folder: Path, picture: Path | None = None) -> int:
    """Checks a drive folder and prints what it found; by default the picture is {folder}/check.png. Returns the exit
    status, 1 where there are faults."""
    picture = picture or folder / "check.png"
    found = examine(folder, picture)
    scene = found.scene
    cameras = scene.cameras if scene else ()
    faults = found.faults or [fault for camera in cameras if (fault := distortion_fault(camera))]
    for line in grouped(faults):
        print(line)
    if found.no_picture:
        print(found.no_picture)
    elif scene is not None:
        boxes = scene.tracks and scene.poses != UNPOSED
        seen = ["returns must lie on surfaces, also those of other times"] if scene.frames and scene.sweeps else []
        seen += ["boxes around objects" if seen else "boxes must lie around objects"] if boxes else []
        print(": ".join([f"picture: {picture}", *([", and ".join(seen)] if seen else [])]))
    if faults or scene is None:
        print(counted(len(faults), "fault"))
        return 1
    for sentence in (*drive_warnings(scene), *camera_warnings(scene)):
        print(f"warning: {sentence}")
    for lidar in scene.lidars:
        path = Path(next(sweep.path for sweep in scene.sweeps if sweep.lidar == lidar.name))
        print(f"LiDAR {lidar.name}: {path.name} {columns_sentence(path)}")
    print(summary(scene))
    if scene.frames and not scene.tracks:
        print(methods_sentence(folder))
    print(f"settings to copy:\n\n{needed_settings(scene, folder)}", end="")
    return 0


def methods_sentence(folder: Path) -> str:
    """Which methods a drive folder without boxes gets by default, and why."""
    found = outline(folder, "", folder.absolute().name)
    method = substitute(found.sweeps, found.without_beams) if found else DRIFTING
    names = [method if name == REPLACED else name for name in default_methods()]
    return f"methods: {', '.join(names)} (the drive has {reason(method)}; {HOW})"


def camera_warnings(scene: Scene) -> list[str]:
    """`intrinsics_warnings`, and sentences about cameras whose images contradict their intrinsics, by a trial with some
    images (`drivesplat.preprocess.poses.lens`)."""
    try:
        from drivesplat.preprocess.poses.lens import lens_warnings, with_tested_images  # imports pycolmap

        with tempfile.TemporaryDirectory(prefix="drivesplat-undistorted-") as folder:
            found = lens_warnings(undistorted(with_tested_images(scene), Path(folder)))
    except ImportError as error:
        found = [f"intrinsics are not compared with images: pycolmap or pyceres cannot be imported ({error})"]
    except DatasetError as error:
        found = [f"intrinsics are not compared with images: {error}"]
    return [*intrinsics_warnings(scene), *found]


if __name__ == "__main__":
    sys.exit(main())
