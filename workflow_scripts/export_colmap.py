"""scene.json and the seed points in parser.npz as a text model of COLMAP."""

from drivesplat.workflow.job import job
from drivesplat.export.camera_files import ColmapFiles, export_colmap
from drivesplat.scene.scene import read_scene
from drivesplat.scene.training_record import read_training_record

with job(snakemake) as current:
    files = ColmapFiles(current.output.cameras, current.output.images, current.output.points)
    export_colmap(files, read_scene(current.input.scene), read_training_record(current.input.parser))
