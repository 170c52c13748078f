"""A synthetic world's settings into a dataset in nuScenes format."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.settings.world import WorldJob
from drivesplat.world.generate import make_world

with job(snakemake) as current:
    root = Path(current.output.tables[0]).parents[1]
    make_world(root, current.settings(WorldJob), current.provenance(), current.threads)
