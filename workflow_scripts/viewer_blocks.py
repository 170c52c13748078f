"""The eval.json of a drive as viewer.html: a map of its path with the pages of its blocks."""

from pathlib import Path

from drivesplat.workflow.job import job
from drivesplat.export.drive_map import drive_map_page
from drivesplat.io.html_page import write_page
from drivesplat.io.storage import read_record
from drivesplat.scene.blocks import read_blocks
from drivesplat.scene.scene import read_scene

with job(snakemake) as current:
    files, method = current.input, current.wildcards.method
    scene, blocks = read_scene(files.scene), read_blocks(files.blocks)
    record = read_record(files.metrics, "evaluate_blocks", "protocol", "result", "provenance")
    of_blocks = map(read_scene, files.scenes)
    starts = {own.name: min(frame.timestamp for frame in own.frames) for own in of_blocks}
    provenance = current.provenance(record["provenance"])
    write_page(Path(current.output.viewer), drive_map_page(scene, blocks, starts, record, method, provenance))
