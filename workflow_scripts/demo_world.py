"""A synthetic world's settings into a dataset in nuScenes format."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.demo.world import make_world
from drivesplat.settings.world import WorldJob

with job(snakemake) as current:
    root = Path(current.output.tables[0]).parents[1]
    make_world(root, current.settings(WorldJob), current.provenance(), current.threads)
