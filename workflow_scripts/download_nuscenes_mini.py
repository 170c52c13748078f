"""nuScenes mini into the folder where the config looks for it."""

from drivesplat.workflow.job import job
from drivesplat.readers.nuscenes.download.nuscenes_mini import download
from drivesplat.settings.download import DownloadJob

with job(snakemake) as current:
    download(current.settings(DownloadJob))
