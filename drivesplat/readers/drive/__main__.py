"""`python -m drivesplat.readers.drive`: checks a drive folder, prints the schema of drive.json, or writes a folder."""

import argparse
import json
import sys
from pathlib import Path

from drivesplat.errors import DriveSplatError
from drivesplat.preprocess.camera_check import camera_warnings
from drivesplat.preprocess.undistort import distortion_fault
from drivesplat.readers.drive.check import check, summary, whole_scene
from drivesplat.readers.drive.format import Drive, grouped, read_drive
from drivesplat.readers.drive.nerfstudio import add_command
from drivesplat.readers.drive.write import write_drive
from drivesplat.readers.drive_checks import jumps
from drivesplat.readers.plausibility import lidar_warnings, pose_warnings
from drivesplat.scene.scene import read_scene


def main(arguments: list[str] | None = None) -> int:
    """Runs a command; returns the exit status, 1 where a folder has faults."""
    parser = argparse.ArgumentParser(prog="python -m drivesplat.readers.drive", description=__doc__)
    commands = parser.add_subparsers(required=True)
    checking = commands.add_parser("check", help="list every fault of a drive folder, and draw a picture")
    checking.add_argument("folder", type=Path)
    checking.add_argument("--picture", type=Path, help="where the picture is written; by default {folder}/check.png")
    checking.set_defaults(run=_check)
    schema = commands.add_parser("schema", help="print the JSON schema of drive.json")
    schema.set_defaults(run=_schema)
    writing = commands.add_parser("write", help="write an extracted scene as a drive folder")
    writing.add_argument("scene", type=Path, help="a scene.json, such as results/0061/scene.json")
    writing.add_argument("folder", type=Path)
    writing.add_argument("--licence", default="", help="who may use the recording, and for what")
    writing.set_defaults(run=_write)
    add_command(commands)
    asked = parser.parse_args(arguments)
    try:
        return asked.run(asked)
    except DriveSplatError as error:
        print(f"drivesplat: {error}", file=sys.stderr)
        return 1


def _check(asked: argparse.Namespace) -> int:
    picture = asked.picture or asked.folder / "check.png"
    faults = check(asked.folder, picture) or _distortion_faults(asked.folder)
    for line in grouped(faults):
        print(line)
    if picture.exists():
        print(f"picture: {picture}: returns must lie on surfaces, also those of other times, and boxes around objects")
    if faults:
        print(f"{len(faults)} fault{'s' if len(faults) > 1 else ''}")
        return 1
    scene = whole_scene(read_drive(asked.folder), asked.folder)
    for sentence in (*jumps(scene), *pose_warnings(scene), *lidar_warnings(scene), *camera_warnings(scene)):
        print(f"warning: {sentence}")
    print(summary(scene))
    return 0


def _distortion_faults(folder: Path) -> list[str]:
    cameras = whole_scene(read_drive(folder), folder).cameras
    return [fault for camera in cameras if (fault := distortion_fault(camera))]


def _schema(_: argparse.Namespace) -> int:
    print(json.dumps(Drive.model_json_schema(by_alias=True), indent=2))
    return 0


def _write(asked: argparse.Namespace) -> int:
    print(write_drive(read_scene(asked.scene), asked.folder, asked.licence))
    return 0


if __name__ == "__main__":
    sys.exit(main())
