"""The command `drivesplat segment`: weights of segmentation networks.

drivesplat segment fetch
drivesplat segment fetch openmmlab/upernet-convnext-tiny
"""

import argparse
from typing import Any

from drivesplat.settings.segment import DEFAULT, DEFAULT_MODEL, model_name

COMMAND = "segment"


def add_parser(commands: Any) -> None:
    """Adds the command to the sub-parsers of `drivesplat`."""
    parser = commands.add_parser(COMMAND, help="fetch the weights of a segmentation network (docs/masks.md)")
    actions = parser.add_subparsers(required=True, dest="action", metavar="fetch")
    fetch = actions.add_parser("fetch", help="download a model from Hugging Face, once")
    fetch.add_argument(
        "model", nargs="?", default=DEFAULT, help=f"its name there, owner/name ({DEFAULT}: {DEFAULT_MODEL})"
    )


def run_segment(parsed: argparse.Namespace) -> int:
    """Says what is known of the model's licence, and downloads it. Returns the exit status."""
    from drivesplat.preprocess.segmentation.weights import about, fetch

    model = model_name(parsed.model)
    print(f"{model}: {about(model)}", flush=True)
    folder = fetch(model)
    print(f"{folder}: fetched; to use it, write segment: {{model: {parsed.model}}}")
    return 0
