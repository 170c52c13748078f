"""Settings of the rule `download_nuscenes_mini`."""

from pydantic import Field

from drivesplat.settings import Settings


class NuscenesMiniSettings(Settings):
    url: str = Field("https://www.nuscenes.org/data/v1.0-mini.tgz", pattern="^https?://.")
    """URL of the archive."""
    size_bytes: int = Field(4_167_696_325, ge=1)
    """Size of the archive in bytes. The archive on nuScenes' download page, behind its login, has another size."""
    sha256: str | None = Field(
        "943037abbb3b26b3070dc76504a43eb440503b00baf9ac2f1538d9c03fc9298f", pattern="^[0-9a-f]{64}$"
    )
    """SHA-256 of the archive. nuScenes publishes none; this value was recorded by earlier downloads. For another
    archive that you trust, set the output of `sha256sum`. null = only the size is checked, with a warning."""
    timeout_s: float = Field(60.0, gt=0, le=3600)
    """Timeout of a silent connection (seconds)."""
    min_kb_per_s: float = Field(5.0, ge=0)
    """Minimum rate of a connection (kB/s), averaged over `timeout_s`. A slower one is broken off. 0 = no
    minimum."""
    attempts: int = Field(3, ge=1, le=1000)
    """Number of successive connections that end within their first megabyte before a run gives up. The next run
    resumes the download."""
    max_unpacked_gb: float = Field(7.0, gt=0, le=1000)
    """Maximum unpacked size (GB). This much disk space must be free in addition to the archive."""
    max_files: int = Field(100_000, ge=1)
    """Maximum number of files and folders in the archive. nuScenes mini has about 31,000."""
    keep_archive: bool = False
    """Keep the archive in the folder {dataroot}.download after unpacking."""


class DownloadJob(Settings):
    """All settings of one download."""

    accept_nuscenes_terms: bool
    dataset: str
    """Name of the dataset to download."""
    dataroot: str
    version: str
    nuscenes_mini: NuscenesMiniSettings
