"""The command `drivesplat check`: what a recording holds and lacks, which methods it is fit for, what these cost on
this machine, and the settings to start with. Nothing is trained, and the recording is left as it is.

drivesplat check ~/data/nuscenes/v1.0-mini --scene 0103
"""

import argparse
from pathlib import Path
from typing import Any

COMMAND = "check"


def add_parser(commands: Any) -> None:
    """Adds the command to the sub-parsers of `drivesplat`."""
    text = "check a recording, and print the settings that it needs (docs/own_data.md)"
    add_arguments(commands.add_parser(COMMAND, help=text))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the arguments of a check."""
    parser.add_argument("place", type=Path, help="folder of a recording of any format, or a config file")
    parser.add_argument("--scene", help="by default the first")
    parser.add_argument("--version", help="of the dataset, where the folder holds several")
    parser.add_argument("--picture", type=Path, help="by default FOLDER/check.png, or check-SCENE.png here")
