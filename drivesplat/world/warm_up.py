"""`python -m drivesplat.world.warm_up`: a tiny synthetic world, which compiles and caches the kernels of worlds.

This takes some 10 seconds. The set-up runs it so that the first world does not have to.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from drivesplat.kernels.warm_up import run_warm_up
from drivesplat.provenance.record import provenance
from drivesplat.settings.world import WorldJob, WorldSettings
from drivesplat.world.generate import make_world

WORLD = WorldSettings(width=64, key_frames=2, cameras=["CAM_FRONT"], sweeps=[])


def warm_up(folder: Path) -> None:
    """Writes WORLD to `folder`, which is empty. Raises what `make_world` raises."""
    made = provenance("demo_world", {}, "", [], {})
    make_world(folder, WorldJob(scene="warm_up", version="v1.0-mini", world=WORLD), made)


def main(arguments: Sequence[str] = ()) -> int:
    """Returns the exit status."""
    return run_warm_up("drivesplat.world.warm_up", warm_up, arguments)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
