"""What the rule `download_nuscenes_mini` may be told."""

from pydantic import Field

from drivesplat.settings import Settings


class NuscenesMiniSettings(Settings):
    url: str = Field("https://www.nuscenes.org/data/v1.0-mini.tgz", pattern="^https?://.")
    """Where the archive is fetched from."""
    size_bytes: int = Field(4_167_696_325, ge=1)
    """The archive's size. nuScenes' download page, behind its login, has another packing of the same drives."""
    sha256: str | None = Field(
        "943037abbb3b26b3070dc76504a43eb440503b00baf9ac2f1538d9c03fc9298f", pattern="^[0-9a-f]{64}$"
    )
    """The archive's SHA-256. nuScenes publishes none: this is what those who fetched it before have recorded. For
    another archive that you trust take what `sha256sum` says; null = its size alone is checked, with a warning."""
    timeout_s: float = Field(60.0, gt=0, le=3600)
    """Longest silence of the server in seconds."""
    attempts: int = Field(3, ge=1, le=1000)
    """Connections in a row that break off within their first megabyte before a run gives up. The next run goes on where
    it stopped."""
    max_unpacked_gb: float = Field(7.0, gt=0, le=1000)
    """An archive that unpacks to more (GB) is refused; so much has to be free on the disk, beside the archive."""
    max_files: int = Field(100_000, ge=1)
    """An archive of more files and folders is refused; nuScenes mini has about 31,000."""
    keep_archive: bool = False
    """Keep the archive, in the folder {dataroot}.download, once it is unpacked."""


class DownloadJob(Settings):
    """Everything that a download has to know."""

    accept_nuscenes_terms: bool
    dataset: str
    """The name of the dataset that it fills."""
    dataroot: str
    version: str
    nuscenes_mini: NuscenesMiniSettings
