"""Settings of a dataset, recorded or synthetic: its location, its scenes and its overrides."""

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from drivesplat.settings import Settings
from drivesplat.settings.blocks import BlockSettings, drive_of
from drivesplat.settings.names import require_text
from drivesplat.settings.world import WorldSettings

MINI_SCENES = ("0061", "0103", "0553", "0655", "0757", "0796", "0916", "1077", "1094", "1100")
DEMO_OVERRIDES = {
    "lidar_seed": {"max_points": 25_000, "far_points": 8_000},
    "train": {
        "iterations": 800,
        "cap_max": 40_000,
        "min_checkpoint_interval_s": 10.0,
        "image_every": 250,
        "psnr_every": 200,
        "max_scale": 0.1,
    },
    "render": {"fps": 12, "width": 576, "height": 324, "compare": False},
    "device": {"min_free_gb": 1.0},
}
"""With these, the demo trains and renders within minutes on a CPU."""


class DatasetSettings(Settings):
    reader: Literal["nuscenes", "drive", "waymo", "ncore"] = "nuscenes"
    """:printed: Dataset format: 'nuscenes', 'waymo' (docs/waymo.md), 'ncore' (docs/ncore.md), or 'drive', a folder
    that you write (docs/own_data.md)."""
    dataroot: str = "~/data/nuscenes/v1.0-mini"
    """:printed: Folder that contains the folder of tables (or that folder itself, or its grandparent)."""
    version: str = "v1.0-mini"
    """:printed: Name of the folder of tables: v1.0-mini, v1.0-trainval, ... Waymo: v1 or v2, needed only where both are
    there."""
    scenes: tuple[str, ...] = MINI_SCENES
    """:printed: Scene numbers in quotes. YAML reads a bare 0061 as an octal number. Waymo: names of segments; NCore:
    of clips."""
    frames: dict[str, tuple[int, int]] = Field(default_factory=dict)
    """:printed: Range of key frames to use, by scene: [first, last + 1). They are then counted from 0. Other scenes are
    used completely."""
    edits: dict[str, str] = Field(default_factory=dict)
    """:printed: Edits file, by scene (docs/editing.md)."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """:printed: Settings that differ for this dataset, as a tree: {images: {width: 800}}."""
    blocks: BlockSettings | None = None
    """:printed: Cut each drive into blocks along its path, which are trained one by one (docs/long_drives.md):
    {length_m: 150}. null = a drive is trained as a whole."""
    batch: bool = True
    """:printed: Include its scenes in a bare `snakemake` and in the report."""
    world: WorldSettings | None = None
    """:printed: Synthetic street with one scene, generated at dataroot. null = a recorded dataset that is already
    there."""

    @property
    def world_root(self) -> str:
        """The folder in which `world` is generated: relative to the working directory where it is below it, since
        Snakemake compares paths as text."""
        path = Path(self.dataroot).expanduser()
        return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)

    def left_out(self, scene: str) -> tuple[int, ...]:
        """The numbers of the blocks of a scene without which its results are made; none unless it is cut."""
        return self.blocks.left_out(scene) if self.blocks else ()

    @field_validator("scenes", mode="before")
    @classmethod
    def _scenes_are_quoted(cls, value: Any) -> Any:
        for scene in value if isinstance(value, (list, tuple)) else ():
            require_text(scene)
        return value

    @model_validator(mode="after")
    def _scenes_fit_together(self) -> "DatasetSettings":
        if self.world and len(self.scenes) != 1:
            raise ValueError(f"a dataset with a world has one scene, this one has {len(self.scenes)}")
        for scene, (first, last) in self.frames.items():
            if scene not in self.scenes:
                raise ValueError(f"frames names scene {scene!r}, which is not in scenes")
            if not 0 <= first < last:
                raise ValueError(f"frames of scene {scene!r} must be [first, last + 1) with 0 <= first < last + 1")
        if self.blocks:
            self.blocks.require_drives(self.scenes)
        for scene in self.edits:
            if scene not in self.scenes and not (self.blocks and drive_of(scene) in self.scenes):
                raise ValueError(f"edits names scene {scene!r}, which is not in scenes")
        return self


def default_datasets() -> dict[str, DatasetSettings]:
    """nuScenes mini, and the demo world."""
    demo = DatasetSettings(
        dataroot="resources/demo",
        scenes=("demo",),
        edits={"demo": "presets/edits/demo.yaml"},
        batch=False,
        world=WorldSettings(),
        overrides=DEMO_OVERRIDES,
    )
    return {"nuscenes": DatasetSettings(), "demo": demo}
