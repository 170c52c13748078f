"""Scenes without cameras: which stages and methods they have, and the messages about what they lack."""

from collections.abc import Iterable, Sequence

from drivesplat.errors import ConfigError
from drivesplat.settings.config import Config, for_scene
from drivesplat.settings.report import HELD_OUT_PAIR, LOOKS
from drivesplat.settings.tracks import OTHER_TRACKS
from drivesplat.workflow.without_tracks import methods_of

LIDAR_SCENE_STAGES = ("extract", "parser", "scene_metrics")
LIDAR_METHOD_STAGES = ("train", "evaluate_scans")
"""The stages behind the metrics.json of a scene without cameras, of the scene and of each of its methods."""
CAMERA_STAGES = (
    "own_car", "lidar_seed", "segment", "masks", "regions", "lidar_depth", "evaluate", "ablation", "tracks",
    "film", "film_parts", "truth_film", "compare", "edit", "quad", "recorded_frames", "drive_folder", "ghost_panel",
    "remove_actor", "far_gaussians", "export", "export_usd", "export_viewer", "export_colmap", "export_spz",
    "export_sog", "export_alpasim",
)  # fmt: skip
"""Stages that need images."""
IMAGE_RESULTS = (
    "own_car.json", "triangulated.npz", "seed.ply", "masks", "segmented", "lidar_depth.npz",
    "tracks.csv", "tracks.png", "compare.mp4", "compare.json", "ablation.csv", "ablation.json",
)  # fmt: skip
"""The files and folders of a scene that these stages make."""
IMAGE_RESULTS_OF_METHODS = (
    *HELD_OUT_PAIR.values(), *LOOKS.values(), "removal.png", "ghost_panel.json", "removal.json", "quad", "far.npz",
    "splat.ply", "cameras.json", "transforms.json", "parts", "scene.usdz", "viewer.html", "colmap", "splat.spz",
    "splat.sog", "scene.alpasim.usdz", "truth.mp4", "truth.json", "eval_objects.json",
    "recorded_frames.npy",
)  # fmt: skip
"""Those of a method, without films, edits and drive folders."""
HOW = "docs/lidar.md says what there is without cameras"


def has_cameras(config: Config, scene: str) -> bool:
    """Whether a scene's settings name cameras."""
    return bool(for_scene(config, scene).cameras)


def scene_methods(config: Config, scene: str) -> list[str]:
    """The methods of a scene, without cameras those that render LiDAR."""
    every = has_cameras(config, scene)
    return [method for method in methods_of(config, scene) if every or _renders_lidar(config, scene, method)]


def _renders_lidar(config: Config, scene: str, method: str) -> bool:
    return for_scene(config, scene, method).train.scans.per_image > 0


def no_camera(scene: str) -> str:
    """The beginning of messages about what a scene without cameras lacks."""
    return f"scene {scene} has no camera (cameras: [])"


def require_methods(config: Config, scene: str) -> None:
    """Raises ConfigError for a scene without cameras that no method can be trained on."""
    if not scene_methods(config, scene):
        raise ConfigError(
            f"{no_camera(scene)}, and no method renders LiDAR; add one with train.scans.per_image above 0, such as "
            "street_lidar of presets/lidar.yaml"
        )


def refuse_image_results(config: Config, scene: str, path: Sequence[str], films: Iterable[str]) -> None:
    """Raises ConfigError if `path` below the folder of a scene without cameras is that of a method that renders no
    LiDAR, or needs images; `films` are the names of films."""
    if has_cameras(config, scene):
        return
    name, *rest = path[1:] if path[0] in OTHER_TRACKS and len(path) > 1 else path
    if name in config.all_methods and not _renders_lidar(config, scene, name):
        able = ", ".join(scene_methods(config, scene)) or "none (presets/lidar.yaml adds one)"
        raise ConfigError(
            f"{no_camera(scene)}, and method {name!r} renders images alone; those that render LiDAR: {able}"
        )
    shown = {*IMAGE_RESULTS_OF_METHODS, *(f"{film}{end}" for film in films for end in (".mp4", ".cameras.json"))}
    edit = rest[:1] == ["edits"] and rest[-1].endswith((".mp4", ".png", "scans.json"))
    of_images = rest[-1:] in (["drive.json"], ["drive.mcap"]) and rest[0] != "runs"
    if name in IMAGE_RESULTS or (rest and (rest[0] in shown or edit or of_images)):
        raise ConfigError(f"{no_camera(scene)}: {'/'.join(path)} needs images; {HOW}")


def methods_left_out(config: Config, scenes: Iterable[str]) -> list[str]:
    """A sentence for each of these scenes' datasets without cameras about its methods that render images alone."""
    first = {config.dataset_of(scene): scene for scene in scenes}
    sentences = []
    for dataset, scene in sorted(first.items()):
        absent = [method for method in methods_of(config, scene) if method not in scene_methods(config, scene)]
        if absent:
            sentences.append(
                f"dataset {dataset} has no camera (cameras: []): methods that render images alone are left out there "
                f"({', '.join(absent)})"
            )
    return sentences
