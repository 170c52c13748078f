"""checkpoint.npz before a moving vehicle, into ghost_panel.png and ghost_panel.json."""

from drivesplat.workflow.job import job
from drivesplat.io.storage import write_json
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.evaluation_data import read_evaluation_data
from drivesplat.settings.visuals import PanelJob
from drivesplat.visuals.drawing import draw_panel
from drivesplat.visuals.figures import save_figure
from drivesplat.visuals.ghost_panel import ghost_panel
from drivesplat.visuals.rendered_view import open_model_with_recording

with job(snakemake, dataset=("images",)) as current:
    files, checkpoint = current.input, read_checkpoint(current.input.checkpoint)
    recording, upstream = read_evaluation_data(files.scene, files.parser, files.masks)
    provenance = current.provenance(*upstream, checkpoint.provenance)
    panel, figures = ghost_panel(
        open_model_with_recording(checkpoint, recording, current.device()), current.settings(PanelJob)
    )
    save_figure(current.output.panel, draw_panel(panel, figures, current.wildcards.method))
    write_json(current.output.figures, {**figures, "provenance": provenance})
