"""checkpoint.pt as scene.usdz: Gaussians in OpenUSD's schema, and the recording camera."""

from drivesplat.export.usd_asset import export_usd
from drivesplat.job import job
from drivesplat.parser import read_parser
from drivesplat.scene import read_scene
from drivesplat.settings.export import UsdJob
from drivesplat.training.run import read_checkpoint

with job(snakemake) as current:
    scene, parser = read_scene(current.input.scene), read_parser(current.input.parser)
    checkpoint = read_checkpoint(current.input.checkpoint)
    provenance = current.provenance(scene.provenance, parser["provenance"], checkpoint["provenance"])
    export_usd(current.output.usd, checkpoint, parser, scene, current.settings(UsdJob), provenance)
