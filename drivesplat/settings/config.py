"""The configuration: the settings of all rules in one record, and the settings that hold for a scene and a method.

`drivesplat.settings` is the only source of defaults, ranges and comments; config.yaml and config.schema.json are
generated from it (`make config`). This module imports quickly, since the Snakefile imports it.
"""

from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

from pydantic import Field, field_validator, model_validator

from drivesplat.errors import ConfigError
from drivesplat.settings import Settings, validated
from drivesplat.settings.ablation import AblationSettings
from drivesplat.settings.actor_seed import ActorSeedSettings
from drivesplat.settings.blocks import CardSettings, drive_of
from drivesplat.settings.dataset import DatasetSettings, default_datasets
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.discover import DiscoverSettings
from drivesplat.settings.download import NuscenesMiniSettings
from drivesplat.settings.evaluate import LpipsSettings
from drivesplat.settings.export import ExportSettings
from drivesplat.settings.extract import ExtractSettings
from drivesplat.settings.images import HoldoutSettings, ImageSettings
from drivesplat.settings.lidar_depth import LidarDepthSettings
from drivesplat.settings.lidar_seed import LidarSeedSettings
from drivesplat.settings.masks import MaskSettings
from drivesplat.settings.method import VARIATION_OVERRIDES, MethodSettings, built, default_methods, merged
from drivesplat.settings.names import ResultsFolder, require_name, suggestion
from drivesplat.settings.published import PublishedFigures
from drivesplat.settings.refine_poses import RefinePosesSettings
from drivesplat.settings.removed import in_this_version, refuse_removed
from drivesplat.settings.render import RenderSettings
from drivesplat.settings.scans import ScanSettings
from drivesplat.settings.segment import SegmentSettings
from drivesplat.settings.train import SkyKind, TrainSettings
from drivesplat.settings.visuals import GhostSettings, RemovalSettings, SubjectSettings
from drivesplat.settings.without_boxes import REPLACED, substitutes
from drivesplat.settings.world import CameraChannel

DATASET_OVERRIDES = (
    "cameras", "eval_camera", "sweeps", "images", "holdout", "extract", "refine_poses", "lidar_seed", "actors",
    "lidar_depth", "scans", "discover", "masks", "segment", "sky", "train", "render", "ghosts", "removal", "export",
    "device", "replace_street",
)  # fmt: skip
METHOD_OVERRIDES = ("sky", "train", "random_seed")


KEPT_NAMES = {"parts": "a method's parts", "lidar": "LiDAR scans", "truth": "views beside the truth"}
"""The names of films that are no trajectories, and what these show."""


class Config(Settings):
    datasets: dict[str, DatasetSettings] = Field(default_factory=default_datasets, min_length=1)
    """:printed: Datasets, each under a name of your choice."""
    accept_nuscenes_terms: bool = False
    """:printed: Accept nuScenes' terms, https://www.nuscenes.org/terms-of-use (non-commercial use without a licence).
    Until they are accepted, `snakemake download_nuscenes_mini` downloads nothing."""
    nuscenes_mini: NuscenesMiniSettings = NuscenesMiniSettings()
    methods: dict[str, MethodSettings | None] = Field(default_factory=default_methods, min_length=1)
    """:printed: Methods to train and compare, each under a name of your choice, which also names its result folder.
    null drops a method: `methods: {street: null}` in a file laid over this one. vanilla and street stand before all
    others."""
    replace_street: bool = True
    """:printed: On a drive without boxes train `street_discovered` in place of `street`, without LiDAR scans
    `drifting`, unless your own `methods` change `street`. docs/without_boxes.md"""
    ablation: AblationSettings = AblationSettings()
    """:printed: Ablation of a method. Only `snakemake results/{scene}/ablation.csv` trains it."""
    cameras: tuple[str, ...] = ("CAM_FRONT",)
    """:printed: Cameras to train on. [] = none: only methods that render LiDAR are trained and measured
    (docs/lidar.md)."""
    eval_camera: str | None = "CAM_FRONT"
    """:printed: The camera whose held-out images are evaluated. Must be one of `cameras`; without any, null or left
    out."""
    sweeps: bool = False
    """:printed: Train on images between key frames, too, except those within half a key-frame interval of a held-out
    key frame. For LiDAR between key frames see lidar_seed.sweeps. docs/real_logs.md"""
    images: ImageSettings = ImageSettings()
    holdout: HoldoutSettings = HoldoutSettings()
    extract: ExtractSettings = ExtractSettings()
    refine_poses: RefinePosesSettings = RefinePosesSettings()
    lidar_seed: LidarSeedSettings = LidarSeedSettings()
    actors: ActorSeedSettings = ActorSeedSettings()
    lidar_depth: LidarDepthSettings = LidarDepthSettings()
    scans: ScanSettings = ScanSettings()
    discover: DiscoverSettings = DiscoverSettings()
    masks: MaskSettings = MaskSettings()
    segment: SegmentSettings = SegmentSettings()
    sky: SkyKind = "cubemap"
    """:printed: Sky model behind the Gaussians: 'cubemap' (learned colours by direction), 'mask' (one learned colour,
    opacity penalised in sky pixels) or 'none' (black). Without a cube map, Gaussians fill the sky."""
    train: TrainSettings = TrainSettings()
    render: RenderSettings = RenderSettings()
    runs: str | None = None
    """File of runs in the closed loop, for all scenes. docs/closed_loop.md"""
    subjects: dict[str, SubjectSettings] = Field(default_factory=dict)
    """:printed: Vehicle of the ghost panel and of the removal, by scene: {"0061": {track: 6e5c..., key_frame: 12}}.
    Other scenes take the moving vehicle that fills most pixels."""
    ghosts: GhostSettings = GhostSettings()
    removal: RemovalSettings = RemovalSettings()
    export: ExportSettings = ExportSettings()
    lpips: LpipsSettings = LpipsSettings()
    published: tuple[PublishedFigures, ...] = ()
    """:printed: Published figures that the report shows beside measured ones, a list: {source: name of the publication,
    url: its address, scene: "0061", method: its name there, psnr: mean over images in dB, ssim, lpips, train_minutes,
    gpu}. One figure suffices. `scene: mean` is a mean over scenes, `scenes` their number. `group` ('interpolation'
    unless given) and `region` ('all') are those of metrics.json. presets/protocols/ has such lists
    (docs/results.md)."""
    device: DeviceSettings = DeviceSettings()
    random_seed: int = Field(0, ge=0, lt=2**31)
    """:printed: Random seed of all stages."""
    results_dir: ResultsFolder = "results"
    """:printed: Folder of all results, ~ for your home folder. Give each experiment a folder of its own.
    Targets begin with it as it is written here: `<results_dir>/0103/metrics.json`."""

    @field_validator("accept_nuscenes_terms", mode="before")
    @classmethod
    def _text_on_the_command_line(cls, value: Any) -> Any:
        if value in ("true", "false"):
            raise ValueError(f"write {value.capitalize()}: Snakemake's --config takes {value} for text")
        return value

    @model_validator(mode="before")
    @classmethod
    def _methods_are_built(cls, values: Any) -> Any:
        if not isinstance(values, Mapping) or not isinstance(values.get("methods"), Mapping):
            return values
        shipped = {name: method.model_dump(exclude_defaults=True) for name, method in default_methods().items()}
        return {**values, "methods": built(values["methods"], shipped)}

    @field_validator("published", mode="before")
    @classmethod
    def _published_figures_are_a_list(cls, value: Any) -> Any:
        if not isinstance(value, (list, tuple)):
            raise ValueError("it must be a list, each entry of which begins with '- '")
        return value

    @field_validator("methods")
    @classmethod
    def _none_is_no_method(cls, value: dict[str, MethodSettings | None]) -> dict[str, MethodSettings | None]:
        wanted = {name: method for name, method in value.items() if method is not None}
        if not wanted:
            raise ValueError("no method is left; keep one")
        return {name: wanted[name] for name in (*default_methods(), *wanted) if name in wanted}

    @model_validator(mode="after")
    def _names_fit_together(self) -> "Config":
        owners: dict[str, str] = {}
        for name, dataset in self.datasets.items():
            require_name(name, "dataset")
            for scene in dataset.scenes:
                require_name(scene, "scene")
                if owners.setdefault(scene, name) != name:
                    raise ValueError(
                        f"scene {scene!r} is in two datasets, {owners[scene]} and {name}; rename or drop one"
                    )
            if len(set(dataset.scenes)) != len(dataset.scenes):
                raise ValueError(f"datasets.{name}.scenes names a scene twice")
        made = [Path(dataset.world_root).resolve() for dataset in self.datasets.values() if dataset.world]
        if len(set(made)) != len(made):
            raise ValueError("two datasets make their world in the same dataroot; give each its own")
        for kind, names in (("method", self.methods), ("trajectory", self.render.trajectories)):
            for name in names:
                require_name(name, kind)
        for name, film in KEPT_NAMES.items():
            if name in self.render.trajectories:
                raise ValueError(f"a trajectory cannot be called {name!r}: the name is kept for the film of {film}")
        for scene in owners:
            if drive_of(scene) != scene and self.is_cut(drive_of(scene)):
                raise ValueError(f"scene {scene!r} has the name of a block of scene {drive_of(scene)!r}; rename it")
        for scene in self.subjects:
            if not self.is_scene(scene):
                raise ValueError(f"subjects names scene {scene!r}, which is in no dataset")
        if self.cameras and self.eval_camera not in self.cameras:
            message = f"eval_camera {self.eval_camera or 'null'} is not among cameras ({', '.join(self.cameras)})"
            known = get_args(CameraChannel)
            misspelled = (suggestion(camera, known) for camera in self.cameras if camera not in known)
            meant = next(filter(None, misspelled), "")
            raise ValueError(f"{message}: {meant}nuScenes has {', '.join(known)}" if meant else message)
        if not self.cameras and self.eval_camera not in (None, type(self).model_fields["eval_camera"].default):
            raise ValueError(
                f"eval_camera {self.eval_camera} is set, but cameras is empty: nothing is measured on images; write "
                "eval_camera: null beside cameras: []"
            )
        for camera in self.holdout.cameras:
            if camera not in self.cameras:
                raise ValueError(f"holdout.cameras: {camera} is not among cameras ({', '.join(self.cameras)})")
            if camera == self.eval_camera:
                raise ValueError(f"holdout.cameras: {camera} is eval_camera, whose images are trained on")
        if self.scans.sweeps and not self.lidar_seed.sweeps:
            raise ValueError("scans.sweeps needs lidar_seed.sweeps: true, which reads LiDAR between key frames")
        return self

    @model_validator(mode="after")
    def _variants_have_names_of_their_own(self) -> "Config":
        for name in self.ablation.without:
            require_name(name, "variant")
        for name in self.ablated:
            if name in self.methods:
                raise ValueError(f"method {name!r} is called like a variant of the ablation; rename it")
        return self

    @cached_property
    def places(self) -> dict[tuple[str, str | None], "Config"]:
        """Cache of `for_scene`, by representative dataset and method: rules call it hundreds of times."""
        return {}

    @cached_property
    def representative(self) -> dict[str, str]:
        """The first dataset with equal overrides, by dataset: `for_scene` gives both the same settings."""
        found: dict[str, str] = {}
        for name, dataset in self.datasets.items():
            first = dict.fromkeys(found.values())
            found[name] = next((at for at in first if self.datasets[at].overrides == dataset.overrides), name)
        return found

    @cached_property
    def outlines(self) -> dict[str, Any]:
        """Cache of `workflow.without_tracks`: the outlines of recordings, by scene."""
        return {}

    @cached_property
    def untracked(self) -> dict[str, bool]:
        """Cache of the same: whether recordings lack tracks, by scene."""
        return {}

    @cached_property
    def substitutes(self) -> dict[str, MethodSettings]:
        """The methods of which one takes the place of `street` on a drive without boxes, by name: those of the config
        where it has such names. Empty where `street` is dropped or changed."""
        if self.methods.get(REPLACED) != default_methods()[REPLACED]:
            return {}
        return {name: self.methods.get(name) or method for name, method in substitutes().items()}

    @cached_property
    def ablated(self) -> dict[str, MethodSettings]:
        """The methods of the ablation, by name; empty where the ablated method is not configured."""
        whole = self.methods.get(self.ablation.of)
        return self.ablation.methods(whole) if whole else {}

    @property
    def all_methods(self) -> dict[str, MethodSettings]:
        """The configured methods, those that take the place of `street` on drives without boxes, and those of the
        ablation."""
        return {**self.methods, **self.substitutes, **self.ablated}

    @cached_property
    def dataset_names(self) -> dict[str, str]:
        """The name of every scene's dataset, by scene, in order."""
        return {scene: name for name, dataset in self.datasets.items() for scene in dataset.scenes}

    @property
    def scenes(self) -> list[str]:
        """All configured scenes, in order."""
        return list(self.dataset_names)

    @property
    def batch_scenes(self) -> list[str]:
        """The scenes of a bare `snakemake` and of the report."""
        return [scene for dataset in self.datasets.values() if dataset.batch for scene in dataset.scenes]

    def dataset_of(self, scene: str) -> str:
        """The name of a scene's dataset. Raises ConfigError, with the list of scenes, for an unknown scene."""
        drive = scene if scene in self.dataset_names else drive_of(scene)
        if not self.is_scene(scene):
            raise ConfigError(
                f"scene {scene!r} is not in the config; {suggestion(scene, self.scenes)}"
                f"there are: {', '.join(self.scenes)} (add it, quoted, to datasets.<name>.scenes)"
            )
        return self.dataset_names[drive]

    def is_cut(self, scene: str) -> bool:
        """Whether this is a configured scene that is cut into blocks."""
        return scene in self.dataset_names and self.datasets[self.dataset_names[scene]].blocks is not None

    def card(self, dataset: str) -> CardSettings | None:
        """What the length of the blocks of a dataset is chosen by, in the config of one of its scenes; None where it is
        given."""
        cut = self.datasets[dataset].blocks
        if cut is None or cut.length_m != "auto":
            return None
        return CardSettings(memory_gb=cut.memory_gb, gaussians=self.train.cap_max, width=self.images.width)

    def is_scene(self, name: str) -> bool:
        """Whether this is the name of a configured scene, or that of a block of one."""
        return name in self.dataset_names or self.is_block(name)

    def is_block(self, name: str) -> bool:
        """Whether this is the name of a block of a scene that is cut into blocks, which need not exist."""
        return name not in self.dataset_names and self.is_cut(drive_of(name))


def in_current_names(values: Mapping[Any, Any]) -> tuple[dict[Any, Any], list[str]]:
    """The values of a config as this version has them, and notes of what the next one will refuse."""
    return in_this_version(values, lambda: Config().model_dump())


def load(values: Mapping[str, Any]) -> Config:
    """Validates a config with its overrides. Raises ConfigError: one line with key, value and allowed range."""
    if "provenance" in values:
        raise ConfigError(
            "a result of this workflow is among the config files, where Snakemake takes what follows --configfile: "
            "put -- before the targets, as in --configfile mine.yaml -- results/0103/metrics.json"
        )
    config = validated(Config, in_current_names(values)[0])
    variants = {name: variant for name, variant in config.ablation.without.items() if variant is not None}
    for kind, named, allowed in (
        ("datasets", config.datasets, DATASET_OVERRIDES),
        ("methods", config.methods, METHOD_OVERRIDES),
        ("ablation.without", variants, VARIATION_OVERRIDES),
    ):
        for name, item in named.items():
            require_known(item.overrides, allowed, f"{kind}.{name}.overrides")
            _overridden(config, item.overrides, f"{kind}.{name}.overrides")
    return config


def for_scene(config: Config, scene: str, method: str | None = None) -> Config:
    """The config of one scene, and of one method where given. Raises ConfigError for an unknown scene."""
    dataset, known = config.representative[config.dataset_of(scene)], config.places
    if (dataset, None) not in known:
        known[dataset, None] = _overridden(config, config.datasets[dataset].overrides, f"datasets.{dataset}.overrides")
    if (dataset, method) not in known:
        there = known[dataset, None]
        known[dataset, method] = _overridden(there, there.all_methods[method].overrides, f"the overrides of {method}")
    return known[dataset, method]


def _overridden(config: Config, overrides: Mapping[str, Any], where: str) -> Config:
    if not overrides:
        return config
    return validated(Config, merged(config.model_dump(), overrides), f"(with {where}) ")


def require_known(overrides: Mapping[str, Any], allowed: Iterable[str], where: str) -> None:
    """Raises ConfigError where the tree of overrides at `where` sets a key that is not `allowed`, or was removed."""
    refuse_removed(overrides, f"{where}.")
    for key in overrides:
        if key not in allowed:
            raise ConfigError(f"'{where}.{key}' cannot be set there; what can: {', '.join(allowed)}")
