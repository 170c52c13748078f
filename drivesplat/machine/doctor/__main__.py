"""What works on this machine and what does not, a line each.

Exit status 0: the CPU demo can run and nothing
is broken (there may be notes); 1: at least one `fix`.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from drivesplat import IS_CHECKOUT, WORKFLOW
from drivesplat.io.standard_output import standard_output
from drivesplat.io.this_copy import in_this_copy


def main(arguments: Sequence[str]) -> int:
    """Prints the findings. Returns the exit status."""
    command = "python -m drivesplat.machine.doctor" if IS_CHECKOUT else "drivesplat doctor"
    parser = argparse.ArgumentParser(command, description=__doc__)
    parser.add_argument("config", nargs="*", type=Path, help="merged over config.yaml in this order (presets)")
    files = parser.parse_args(arguments).config
    try:
        from drivesplat.io.this_copy import default_config, of_the_workflow
        from drivesplat.machine.doctor.checks import examine
        from drivesplat.machine.doctor.facts import gather
    except ImportError as error:
        remedy = in_this_copy("run make setup, then make doctor")
        print(f"fix   packages      {error} in {sys.executable}: {remedy}")
        return 1
    if IS_CHECKOUT:
        os.chdir(WORKFLOW)
    here = Path.cwd()
    findings = examine(gather(here, [default_config(here, WORKFLOW), *(of_the_workflow(file) for file in files)]))
    width = max(len(finding.topic) for finding in findings)
    for finding in findings:
        print(f"{finding.level:4}  {finding.topic:{width}}  {in_this_copy(finding.text)}")
    broken = sum(finding.level == "fix" for finding in findings)
    everything = in_this_copy("Nothing is broken: make demo runs without GPU and data.")
    print(f"\n{broken} to fix" if broken else f"\n{everything}")
    return 1 if broken else 0


if __name__ == "__main__":
    status = 0
    with standard_output():
        status = main(sys.argv[1:])
    sys.exit(status)
