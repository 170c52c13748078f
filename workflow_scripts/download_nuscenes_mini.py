"""nuScenes mini into the folder where the config looks for it."""

from drivesplat.job import job
from drivesplat.download.nuscenes_mini import download
from drivesplat.settings.download import DownloadJob

with job(snakemake) as current:
    download(current.settings(DownloadJob))
