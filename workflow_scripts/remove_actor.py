"""checkpoint.npz with and without a vehicle, into with_car.png, without_car.png, removal.png and removal.json."""

from drivesplat.workflow.job import job
from drivesplat.io.storage import write_json
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.scene.evaluation_data import read_evaluation_data
from drivesplat.scene.images import write_image
from drivesplat.settings.visuals import RemovalJob
from drivesplat.visuals.drawing import draw_removal
from drivesplat.visuals.figures import save_figure
from drivesplat.visuals.removal import remove_actor
from drivesplat.visuals.rendered_view import open_model_with_recording

with job(snakemake, dataset=("images",)) as current:
    files, made, checkpoint = current.input, current.output, read_checkpoint(current.input.checkpoint)
    recording, upstream = read_evaluation_data(files.scene, files.parser, files.masks)
    provenance = current.provenance(*upstream, checkpoint.provenance)
    pair, record = remove_actor(
        open_model_with_recording(checkpoint, recording, current.device()), current.settings(RemovalJob)
    )
    write_image(made.with_car, pair.with_car)
    write_image(made.without_car, pair.without_car)
    save_figure(made.triptych, draw_removal(pair, record, current.wildcards.method))
    write_json(made.figures, {**record, "provenance": provenance})
