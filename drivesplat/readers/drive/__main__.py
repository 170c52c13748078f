"""`python -m drivesplat.readers.drive`: checks a drive folder, prints the schema of drive.json, or writes a folder."""

import argparse
import json
import sys
from pathlib import Path

from drivesplat.cli.check import COMMAND, add_arguments
from drivesplat.cli.check.command import run_check
from drivesplat.errors import DriveSplatError
from drivesplat.io.standard_output import standard_output
from drivesplat.readers.drive.format import Drive
from drivesplat.readers.drive.nerfstudio import add_command
from drivesplat.readers.drive.write import write_drive
from drivesplat.scene.scene import read_scene


def main(arguments: list[str] | None = None) -> int:
    """Runs a command; returns the exit status, 1 where a folder has faults."""
    parser = argparse.ArgumentParser(prog="python -m drivesplat.readers.drive", description=__doc__)
    commands = parser.add_subparsers(required=True)
    checking = commands.add_parser(COMMAND, help="list every fault of a drive folder, and draw a picture")
    add_arguments(checking)
    checking.set_defaults(run=run_check)
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


if __name__ == "__main__":
    sys.exit(main())
