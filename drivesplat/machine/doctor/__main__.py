"""What works on this machine and what does not, a line each.

Exit status 0: the CPU demo can run and nothing
is broken (there may be notes); 1: at least one `fix`.
"""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).parents[3]


def main(arguments: Sequence[str]) -> int:
    """Prints the findings. Returns the exit status."""
    parser = argparse.ArgumentParser("python -m drivesplat.machine.doctor", description=__doc__)
    parser.add_argument("config", nargs="*", type=Path, help="merged over config.yaml in this order (presets)")
    files = parser.parse_args(arguments).config
    try:
        from drivesplat.machine.doctor.checks import examine
        from drivesplat.machine.doctor.facts import gather
    except ImportError as error:
        print(f"fix   packages      {error} in {sys.executable}: run make setup, then make doctor")
        return 1
    os.chdir(ROOT)
    findings = examine(gather(ROOT, [Path("config.yaml"), *files]))
    width = max(len(finding.topic) for finding in findings)
    for finding in findings:
        print(f"{finding.level:4}  {finding.topic:{width}}  {finding.text}")
    broken = sum(finding.level == "fix" for finding in findings)
    print(f"\n{broken} to fix" if broken else "\nNothing is broken: make demo runs without GPU and data.")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
