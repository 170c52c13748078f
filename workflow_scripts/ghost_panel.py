"""checkpoint.pt before a moving vehicle, into ghost_panel.png and ghost_panel.json."""

from pathlib import Path

from drivesplat.actors.drawing import draw_panel, save_figure
from drivesplat.actors.panel import ghost_panel
from drivesplat.actors.sight import open_drive
from drivesplat.job import job
from drivesplat.masks import read_masks_record
from drivesplat.parser import read_parser
from drivesplat.scene import read_scene
from drivesplat.settings.actor import PanelJob
from drivesplat.storage import write_json
from drivesplat.training.run import read_checkpoint

with job(snakemake) as current:
    files, masks = current.input, Path(current.input.masks).parent
    parser, checkpoint, scene = read_parser(files.parser), read_checkpoint(files.checkpoint), read_scene(files.scene)
    record = read_masks_record(masks)
    provenance = current.provenance(*(made["provenance"] for made in (parser, checkpoint, record)), scene.provenance)
    drive = open_drive(checkpoint, scene, parser, current.device())
    panel, figures = ghost_panel(drive, masks, current.settings(PanelJob))
    save_figure(current.output.panel, draw_panel(panel, figures, current.wildcards.method))
    write_json(current.output.figures, {**figures, "provenance": provenance})
