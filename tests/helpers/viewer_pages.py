"""Pages of viewer.html for tests: what they show, rendered by the model too, and what a user does there."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from drivesplat.export.sampled_motion import SampledMotion
from drivesplat.export.trained_parts import SampledGroup
from drivesplat.export.viewer import viewer_page
from drivesplat.export.viewer_scene import RecordedPath, ViewerContent
from drivesplat.model.background import Background
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.part import Sky
from drivesplat.model.sky import CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Frame, Track
from drivesplat.settings.train import GaussianSettings
from helpers.chromium import Tab
from helpers.classed import classed
from helpers.hand_made_traffic import TURNING, own_gaussians

COUNT = 60
PROVENANCE = {"settings_sha256": "a" * 64, "stages": {"train": {"note": "</script><b>"}}}
WIDTH, HEIGHT = 240, 135
SHOWN_WITHOUT_WORDS = """new Promise((done) => {
  const look = () => document.documentElement.dataset.shown === "yes" ? done() : setTimeout(look, 20);
  look();
}).then(() => document.querySelectorAll(".over").forEach((over) => (over.style.visibility = "hidden")))"""
"""Waits for the first picture, then makes the controls over it invisible."""


SORTED = """new Promise((done) => {
  const look = () => document.documentElement.dataset.shown === "yes" ? done() : requestAnimationFrame(look);
  requestAnimationFrame(() => requestAnimationFrame(look));
})"""
"""Waits until the picture has its own order: the page draws on with the last one while a worker sorts."""


def settled(tab: Tab) -> np.ndarray:
    """The window once nothing is sorted any more."""
    tab.run(SORTED)
    return tab.picture()


def splats(count: int = COUNT, sh_degree: int = 2) -> Gaussians:
    """In front of `oblique_frame`."""
    generator = torch.Generator().manual_seed(3)
    random = torch.rand(count, 7, generator=generator)
    places = torch.stack([12.0 * random[:, 0] - 6.0, 6.0 * random[:, 1] - 3.0, 5.0 + 15.0 * random[:, 2]], dim=1)
    pose = torch.from_numpy(oblique_frame().camera_to_world).float()
    sh = torch.randn(count, (sh_degree + 1) ** 2, 3, generator=generator)
    sh[:, 1:] *= 0.2
    return Gaussians.of(
        places @ pose[:3, :3].T + pose[:3, 3], torch.randn(count, 4, generator=generator),
        0.02 + 0.8 * random[:, 3:6] ** 3, 0.05 + 0.95 * random[:, 6], sh,
    )  # fmt: skip


def oblique_frame() -> Frame:
    """A camera that is pitched and rolled a little, its principal point off the middle, at half of 480 x 270."""
    down_right = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    turned = Rotation.from_euler("zyx", [0.7, 0.08, 0.03]).as_matrix() @ down_right
    pose = rigid(turned, np.array([5.0, -3.0, 1.6]))
    K = np.array([[410.0, 0.0, 250.5], [0.0, 400.0, 122.25], [0.0, 0.0, 1.0]])
    return Frame("CAM_FRONT", 0, "", 480, 270, K, pose, np.eye(4), True, 0, "")


def ridden(second: float) -> np.ndarray:
    """The recorded camera: from `oblique_frame` on it rides a metre ahead in a second."""
    pose = oblique_frame().camera_to_world
    return rigid(pose[:3, :3], pose[:3, 3] + second * pose[:3, 2])


def path_from(frame: Frame) -> RecordedPath:
    """Two seconds of the recorded camera; the key frame at 0.5 s is held out, and that at 2 s after all training."""
    held_out = {"interpolation": [0.5], "extrapolation": [2.0]}
    poses = np.stack([ridden(0.0), ridden(2.0)])
    return RecordedPath(frame, np.array([0.0, 2.0]), poses, (0.0, 0.5, 2.0), held_out, 1.75)


def page_of(gaussians: Gaussians, sky: Sky | None, antialiased: bool = False, title: str = "test") -> str:
    """The page of a static splat."""
    groups = {"background": SampledGroup(gaussians)}
    content = ViewerContent(groups, sky, antialiased, path_from(oblique_frame()))
    return viewer_page(content, title, PROVENANCE)


def a_sky() -> CubemapSky:
    sky = CubemapSky(8, torch.tensor([0.4, 0.6, 0.8]), 0.01)
    with torch.no_grad():
        texels = sky.params["texels"]
        texels.add_(0.5 * torch.randn(texels.shape, generator=torch.Generator().manual_seed(1)))
    return sky


def a_model(gaussians: Gaussians, sky: Sky | None, antialiased: bool = False) -> SplatModel:
    params = {
        "means": gaussians.means, "quats": gaussians.quats, "scales": torch.log(gaussians.scales),
        "opacities": torch.logit(gaussians.opacities), "sh0": gaussians.sh[:, :1], "shN": gaussians.sh[:, 1:],
    }  # fmt: skip
    return SplatModel([Background(params, GaussianSettings(sh_degree=gaussians.sh_degree), 1.0)], sky, antialiased)


def rendered(model: SplatModel, pose: np.ndarray) -> np.ndarray:
    """What the model shows to a camera like `oblique_frame` at half its size: (135, 240, 3) in [0, 1]."""
    frame = oblique_frame()
    K = torch.from_numpy(frame.intrinsics).float()
    K[:2, 2] += 0.5
    K[:2] *= 0.5
    with torch.no_grad():
        return model.render(View(K, torch.from_numpy(pose).float(), WIDTH, HEIGHT, 0.0)).image.clamp(0, 1).numpy()


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.mean((a - b) ** 2)))


CAR = "0a8dee9e8b4b4b0f8d6c2a5f1e3d4c5b"


def car_pose(second: float) -> np.ndarray:
    """A car ten metres ahead of `oblique_frame` that drives to the right at 3 m/s."""
    camera = oblique_frame().camera_to_world
    turned = Rotation.from_euler("z", 0.3).as_matrix()
    return rigid(turned, camera[:3, 3] + 10.0 * camera[:3, 2] + 3.0 * (second - 1.0) * camera[:3, 0])


def driving_car() -> SampledGroup:
    """It is there for the first one and a half seconds."""
    seconds = np.linspace(0.0, 1.5, 46)
    poses = np.stack([car_pose(second) for second in seconds])
    track = Track(CAR, *classed("vehicle.car"), np.array([4.0, 4.0, 4.0]), np.zeros(0, np.int64),
                  np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros(0, np.int64))  # fmt: skip
    return SampledGroup(own_gaussians(TURNING, 0.0), SampledMotion(seconds, poses, ((0.0, 1.5),), 0.0), track)


def set_second(second: float) -> str:
    return f"""(() => {{
      const time = document.getElementById("time");
      time.value = {second};
      time.dispatchEvent(new Event("input"));
    }})()"""


def click(name: str) -> str:
    """Clicks on a control."""
    return f'document.getElementById("{name}").click()'


def tick(label: str) -> str:
    return f"""[...document.querySelectorAll("#list label")]
      .find((label) => label.textContent.includes("{label}")).firstChild.click()"""


def choose(name: str, value: object) -> str:
    """Chooses from a list."""
    return f"""(() => {{
      const list = document.getElementById("{name}");
      list.value = "{value}";
      list.dispatchEvent(new Event("change"));
    }})()"""
