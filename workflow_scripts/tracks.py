"""scene.json and actors.npz as tracks.csv and tracks.png: the dynamic objects and their ids."""

from drivesplat.workflow.job import job
from drivesplat.scene.evaluation_data import read_evaluation_data
from drivesplat.settings.visuals import TracksJob
from drivesplat.visuals.figures import save_figure
from drivesplat.visuals.track_table import draw_tracks, editable_tracks, subjects_by_image, track_rows, write_tracks

with job(snakemake, dataset=("images",)) as current:
    files, settings = current.input, current.settings(TracksJob)
    camera, actors = settings.eval_camera, settings.actors if files.actors else None
    recording, _ = read_evaluation_data(files.scene, files.parser, files.masks)
    subjects = subjects_by_image(recording, camera)
    rows = track_rows(recording, subjects, editable_tracks(files.actors), actors)
    write_tracks(current.output.table, rows)
    save_figure(current.output.picture, draw_tracks(recording, subjects, rows, camera))
