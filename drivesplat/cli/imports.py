"""The command `drivesplat import`: recordings of other programs as drive folders.

drivesplat import bag monday.mcap
drivesplat import bag monday.mcap --map topics.yaml --out drives/monday
"""

import argparse
from pathlib import Path
from typing import Any

from drivesplat.errors import RequestError
from drivesplat.io.storage import atomic_write

COMMAND = "import"
MAP = Path("topics.yaml")


def add_parser(commands: Any) -> None:
    """Adds the command to the sub-parsers of `drivesplat`."""
    parser = commands.add_parser(COMMAND, help="write a recording of ROS as a drive folder: import bag (own_data.md)")
    kinds = parser.add_subparsers(required=True, dest="kind", metavar="bag")
    bag = kinds.add_parser(
        "bag",
        help="a bag of ROS 1 or ROS 2; without --map: look at it, and propose a map",
        description="Without --map prints the topics of a bag and writes a proposed map, topics.yaml, with the reason "
        "of each decision. With --map writes the drive folder.",
    )
    bag.add_argument(
        "path", type=Path, metavar="BAG", help="a .bag, .mcap or .db3 file, or a folder with metadata.yaml"
    )
    bag.add_argument("--map", type=Path, metavar="FILE", help="the map of topics")
    bag.add_argument("--out", type=Path, metavar="FOLDER", help="a new folder for the drive")
    bag.add_argument("--start", type=float, metavar="S", help="seconds after the first message (0)")
    bag.add_argument("--end", type=float, metavar="S", help="seconds after the first message (the end of the bag)")
    bag.add_argument("--propose", type=Path, default=MAP, metavar="FILE", help=f"where the proposal goes ({MAP})")


def run_import(parsed: argparse.Namespace) -> int:
    """Runs the command with its parsed arguments. Returns the exit status."""
    from drivesplat.readers.drive.bag.bag_import import import_bag, propose

    if (parsed.map is None) != (parsed.out is None):
        raise RequestError("--map and --out belong together; without both a map is proposed")
    if parsed.map is None:
        if parsed.propose.exists():
            raise RequestError(f"{parsed.propose} is there already; remove it, or name another file with --propose")
        text, table = propose(parsed.path, parsed.start, parsed.end)
        with atomic_write(parsed.propose) as file:
            file.write(text.encode())
        print(f"{table}\n\n{parsed.propose}:\n\n{text}")
        window = "".join(
            f" --{name} {value:g}" for name in ("start", "end") if (value := getattr(parsed, name)) is not None
        )
        print(f"Check it, then: drivesplat import bag {parsed.path} --map {parsed.propose} --out FOLDER{window}")
        return 0
    done = import_bag(parsed.path, parsed.map, parsed.out, parsed.start, parsed.end)
    for note in done.notes:
        print(f"note: {note}")
    counts = ", ".join(f"{count} of {name}" for name, count in done.counts.items())
    print(f"{done.path}: {counts}; check it with drivesplat check {parsed.out}")
    return 0
