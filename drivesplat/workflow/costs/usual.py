"""Bytes that a job leaves where no other scene's job tells: by its Gaussians, points and pixels, as on the demo."""

from drivesplat.settings.config import Config, for_scene
from drivesplat.workflow.costs.expected import images_of
from drivesplat.workflow.costs.measured import EDIT, FILM, FILM_PARTS, TRAIN, WORLD, Job

KEY_FRAMES, WIDTH, ASPECT = 40, 1600, 9 / 16
"""Of a scene of nuScenes: frames at 2 Hz, and its images."""
BETWEEN = 5
"""Images that a camera records between two key frames, at 12 Hz."""
MEGABYTES = {
    "extract": 0.3, "refine_poses": 0.5, "masks": 2.0, "actors": 2.0, "lidar_depth": 5.0, "free_space": 5.0,
    "tracks": 1.0, "ghost_panel": 1.5, "remove_actor": 1.0, "evaluate": 0.5, "gap_report": 1.0, "lpips_backbone": 10.0,
}  # fmt: skip
"""Of what stages leave for a scene of nuScenes, whatever the settings."""
OTHERS = 0.1
SKY_AND_CURVES = 2e6
"""Of a training: the sky's cube map in the checkpoint, and TensorBoard's files."""
POINT = 20.0
"""Bytes of a coloured point in seed.ply, and once more in parser.pkl."""
PLY_EXTRA = 3
"""Numbers of a Gaussian that a PLY has beside the checkpoint's: normals, which viewers ask for."""
USD_GAUSSIAN, VIEWER_GAUSSIAN, VIEWER_PAGE = 94.0, 36.0, 0.66e6
FILM_PIXEL = 0.02
"""Bytes of a film's pixel at the default crf; 0.018 at 1920x1080, 0.03 at 800x450."""
FRAME_LABELS = 3.3e3
"""Bytes of an edited frame's boxes."""
FRAME_PIXEL = 1.1
"""Bytes of a pixel of a PNG."""
WORLD_IMAGE, WORLD_PIXEL = 72e3, 0.25
"""Of an image of a synthetic world, its share of LiDAR and truth included: by itself, and of each of its pixels."""


def usual_bytes(config: Config, job: Job) -> float:
    """Bytes that a job of a `config` may leave, within a factor of two or three; on a recorded drive nobody has looked
    at yet, as if it were one of nuScenes' scenes."""
    if job.stage == WORLD:
        return _world(config, job.film)
    if job.stage in (FILM, EDIT, FILM_PARTS):
        return _film(config, job)
    if job.stage in ("lidar_seed", "parser"):
        seed = for_scene(config, job.scene).lidar_seed
        return POINT * (seed.max_points + seed.far_points)
    if not job.method:
        return 1e6 * MEGABYTES.get(job.stage, OTHERS)
    return _of_method(config, job)


def gaussians_of(config: Config, scene: str, method: str) -> int:
    """How many Gaussians a training ends with at most, those of actors left out."""
    there = for_scene(config, scene, method)
    limit = there.train.pixels_per_gaussian
    return min(there.train.cap_max, int(_training_pixels(there, scene) / limit)) if limit else there.train.cap_max


def _of_method(config: Config, job: Job) -> float:
    there, count = for_scene(config, job.scene, job.method), gaussians_of(config, job.scene, job.method)
    numbers = 11 + 3 * (there.train.gaussians.sh_degree + 1) ** 2
    by_stage = {
        TRAIN: SKY_AND_CURVES + 4.0 * numbers * count,
        "export": 2 * 4.0 * (numbers + PLY_EXTRA) * count,  # splat.ply, and the parts by themselves
        "export_usd": USD_GAUSSIAN * min(count, there.export.usd_gaussians),
        "export_viewer": VIEWER_PAGE + VIEWER_GAUSSIAN * min(count, there.export.viewer_gaussians),
    }
    return by_stage.get(job.stage, 1e6 * MEGABYTES.get(job.stage, OTHERS))


def _film(config: Config, job: Job) -> float:
    render = for_scene(config, job.scene).render
    frames = (_key_frames(config, job.scene) - 1) / 2 * render.fps
    pixels = frames * render.width * render.height
    edited = job.stage == EDIT
    return FILM_PIXEL * pixels + edited * (FRAME_LABELS * frames + render.edited_frames * FRAME_PIXEL * pixels)


def _world(config: Config, dataset: str) -> float:
    known = config.datasets.get(dataset)
    world = known.world if known else None
    return images_of(world) * (WORLD_IMAGE + WORLD_PIXEL * ASPECT * world.width**2) if world else 0.0


def _key_frames(config: Config, scene: str) -> int:
    dataset = config.datasets[config.dataset_of(scene)]
    first, last = dataset.frames.get(scene, (0, dataset.world.key_frames if dataset.world else KEY_FRAMES))
    return last - first


def _training_pixels(there: Config, scene: str) -> float:
    """About; `there` is the config as it holds for the scene."""
    world = there.datasets[there.dataset_of(scene)].world
    width = there.images.width or (world.width if world else WIDTH)
    frames = _key_frames(there, scene) * (1 + BETWEEN if there.sweeps else 1)
    return len(there.cameras) * frames * ASPECT * width**2
