"""Settings of exports."""

from typing import Literal

from pydantic import Field, field_validator

from drivesplat.settings import Settings
from drivesplat.settings.edit import Edit
from drivesplat.settings.images import HoldoutSettings, ImageSettings
from drivesplat.settings.render import TrajectorySettings
from drivesplat.settings.simulate import VehicleBody

ExportFormat = Literal["ply", "usd", "viewer", "colmap", "spz", "sog", "alpasim"]
ScanFormat = Literal["npz", "ply", "pcd.bin"]
DriveLabel = Literal["depth", "instances"]

MAX_DISTANCE = 1000.0
"""Metres from the origin of the world beyond which no export holds a Gaussian: what lies there is the sky's."""


class ExportSettings(Settings):
    formats: tuple[ExportFormat, ...] = ("ply", "usd", "viewer", "colmap")
    """:printed: What `snakemake` and `snakemake exports` make: 'ply' (splat.ply, parts, cameras.json, transforms.json),
    'usd' (scene.usdz), 'viewer' (viewer.html), 'colmap' (text model of cameras and seed points), 'spz' (compressed
    splat.spz), 'sog' (splat.sog; needs Node and @playcanvas/splat-transform) and 'alpasim' (scene.alpasim.usdz). The
    other files are made on request."""
    max_distance: float = Field(MAX_DISTANCE, gt=0, le=MAX_DISTANCE)
    """Distance in metres from the world's origin within which all exported Gaussians lie. Those beyond are left out
    where no training image shows it, and moved nearer along the line of sight otherwise. docs/exports.md"""
    sh_degree: int | None = Field(None, ge=0, le=3)
    """Minimum degree of spherical harmonics in PLY, spz and sog files, for viewers that insist on 3: higher
    coefficients are 0. null: the degree of the training."""
    time_s: float | None = Field(None, ge=0)
    """The time in seconds since the first image that splat.ply, spz and sog files show, and whose colours, and shapes
    of people, other exports have where they show no others. null: that of the middle image."""
    usd_gaussians: int = Field(1_000_000, ge=1)
    """Maximum number of Gaussians in scene.usdz, and in each block of a long drive's scene.usd. Those with the largest
    opacity times area are kept."""
    viewer_gaussians: int = Field(300_000, ge=1)
    """Maximum number of Gaussians in viewer.html, which has to fit into a browser's memory."""
    drive_width: int | None = Field(None, ge=16, le=7680)
    """:printed: Width in pixels of the images in rendered drive folders. null: that of the training images."""
    drive_labels: tuple[DriveLabel, ...] = ()
    """Label images in rendered drive folders, beside each image: 'depth' and 'instances' (docs/editing.md)."""
    complete_assets: bool = True
    """Whether assets of actors get the sides that no camera saw from their other side, mirrored and marked
    (docs/assets.md)."""
    viewer_images: int = Field(640, ge=0, le=3840)
    """Width in pixels of the recorded images in viewer.html, one JPEG per key frame, about 30 KB each at 640. 0 = none.
    """

    scan_formats: tuple[ScanFormat, ...] = Field(("npz", "ply"), min_length=1)
    """:printed: Files of rendered LiDAR scans: 'npz' (all rays), 'ply' (returns in world coordinates) and 'pcd.bin'
    (returns as nuScenes has them). They are made on request. docs/lidar.md"""

    vehicle: VehicleBody = Field(default_factory=VehicleBody)
    """The box of the ego vehicle in scene.alpasim.usdz. docs/alpasim_scene.md"""

    @field_validator("formats", "scan_formats")
    @classmethod
    def _once(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(dict.fromkeys(value))


class ExportJob(Settings):
    """All settings that determine one scene.usdz."""

    eval_camera: str
    gaussians: int
    time_s: float | None = None


class BlockUsdJob(ExportJob):
    """All settings that determine scene.usd of a drive that is cut into blocks, some of which may be left out, with the
    payloads beside it: `gaussians` is the maximum of each."""

    left_out: tuple[int, ...]


class ViewerJob(ExportJob):
    """All settings that determine one viewer.html: the width of its images, the edits of the scene that it plays, and
    the methods between whose pages it switches."""

    image_width: int = 0
    edits: dict[str, Edit] = Field(default_factory=dict)
    methods: tuple[str, ...] = ()


class FarJob(Settings):
    """All settings that determine one far.npz."""

    max_distance: float = MAX_DISTANCE


class AlpasimJob(Settings):
    """All settings that determine one scene.alpasim.usdz: the box of the vehicle."""

    body: VehicleBody = Field(default_factory=VehicleBody)


class SplatJob(Settings):
    """All settings that determine one splat.ply with its parts, or one splat.spz."""

    sh_degree: int | None = None
    time_s: float | None = None


class BlockSplatsJob(Settings):
    """All settings that determine the splats of a drive that is cut into blocks, some of which may be left out."""

    left_out: tuple[int, ...]
    sh_degree: int | None


class DriveJob(Settings):
    """All settings that determine one rendered drive folder: the `edit` of its drive, or the `trajectory` beside the
    recorded one. `width` is that of its images in pixels; None: that of the training images. `labels` are the kinds of
    label images to write."""

    eval_camera: str
    cameras: tuple[str, ...]
    images: ImageSettings
    holdout: HoldoutSettings
    width: int | None = None
    labels: tuple[DriveLabel, ...] = ()
    edit: Edit | None = None
    trajectory: TrajectorySettings | None = None


class AssetsJob(Settings):
    """All settings that determine the assets of a method."""

    holdout: HoldoutSettings
    complete: bool = True


class ScanFolderJob(Settings):
    """All settings that determine one folder of rendered scans: the `edit` of its drive, or the `trajectory` beside the
    recorded one. `eval_camera` is None where the scene has no camera, and then no edit."""

    eval_camera: str | None
    formats: tuple[ScanFormat, ...]
    edit: Edit | None = None
    trajectory: TrajectorySettings | None = None
