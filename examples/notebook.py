# %% [markdown]
# # A recorded drive as Gaussian splats, in ten sections
#
# Cells begin with `# %%`: open this file as a notebook in VS Code or with jupytext, or run it as a script. It needs the
# results of `make demo`. DRIVESPLAT_RESULTS names the folder of another scene.

# %%
import json
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch

import drivesplat
from drivesplat.evaluation.summary import print_summary
from drivesplat.machine.doctor.__main__ import main as doctor
from drivesplat.scene.scene import read_scene
from drivesplat.scene.training_record import read_training_record

RESULTS = Path(os.environ.get("DRIVESPLAT_RESULTS", "results/demo"))


def show(*images: np.ndarray, titles: tuple[str, ...] = ()) -> None:
    """Shows images side by side."""
    _, axes = plt.subplots(1, len(images), figsize=(6 * len(images), 4), squeeze=False)
    for number, (axis, image) in enumerate(zip(axes[0], images, strict=True)):
        axis.imshow(image)
        axis.set_title(titles[number] if titles else "")
        axis.axis("off")
    plt.show()


# %% [markdown]
# ## 1. The machine
#
# A GPU renders some hundred images a second. Processors suffice for the demo.

# %%
doctor([])
print(torch.cuda.get_device_name() if torch.cuda.is_available() else f"{os.cpu_count()} processors, no GPU")

# %% [markdown]
# ## 2. The recorded scene
#
# One record for all datasets: images, LiDAR sweeps and tracks, with poses and times.

# %%
scene = read_scene(RESULTS / "scene.json")
print(f"{len(scene.frames)} images, {len(scene.sweeps)} LiDAR sweeps, {len(scene.tracks)} tracks")

# %% [markdown]
# ## 3. Poses are given, not estimated

# %%
path = np.array([frame.ego_to_world[:3, 3] for frame in scene.frames])
plt.plot(path[:, 0], path[:, 1], ".-")
plt.axis("equal")
plt.xlabel("metres")
plt.show()

# %% [markdown]
# ## 4. The training record
#
# The keys are those of gsplat's example trainer. Some images are held out for measuring.

# %%
record = read_training_record(RESULTS / "parser.npz")
print({group: len(images) for group, images in record.splits.items()}, f"{len(record.points)} seed points")

# %% [markdown]
# ## 5. Two trained methods
#
# `vanilla` assumes a static world; `street` gives every moving vehicle Gaussians of its own.

# %%
vanilla, street = (drivesplat.open(RESULTS / method) for method in ("vanilla", "street"))
camera, time = street.cameras[0], 0.6 * street.duration
print(street.actors.to_string())

# %% [markdown]
# ## 6. Render
#
# Depth, object masks and boxes come with the image.

# %%
view = street.render(camera, time, outputs=["rgb", "depth", "instance", "boxes"])
arrays = view.arrays()
show(view.image, np.log1p(arrays["depth"]), arrays["instance"], titles=("colours", "depth", "objects"))
for box in view.boxes:
    print(box.id[:8], box.category, np.round(box.box_2d), f"{box.visible_share:.0%} visible")

# %% [markdown]
# ## 7. Render from another path
#
# Two metres to the left of the recorded path the vehicle that `vanilla` painted on the background falls apart.

# %%
aside = street.camera_to_world(camera, time)
aside[:3, 3] -= 2.0 * aside[:3, 0]
images = [drive.render(camera, time, camera_to_world=aside).image for drive in (vanilla, street)]
show(*images, titles=("vanilla", "street"))

# %% [markdown]
# ## 8. Measure
#
# PSNR of held-out images, of static pixels and of pixels of moving vehicles.

# %%
print_summary(RESULTS / "metrics.json")

# %% [markdown]
# ## 9. Why moving cars fail
#
# Vanilla Gaussians are where they are at all times. Ghosts are Gaussians that only one image sees.

# %%
panel = json.loads((RESULTS / "vanilla/ghost_panel.json").read_text())
print(
    f"vehicle {panel['vehicle']['psnr']} dB, static {panel['static']['psnr']} dB, ghosts {panel['ghosts']['gaussians']}"
)
show(plt.imread(RESULTS / "vanilla/ghost_panel.png"))

# %% [markdown]
# ## 10. Remove a car, move another
#
# A state is the drive at one time. Objects that are not touched stay where they are.

# %%
present = [
    (name, at)
    for at in np.linspace(0.0, street.duration, 20).tolist()
    for name in street.state(at).actors
    if (street.render(camera, at, outputs=["instance"]).arrays()["instance"] >= 0).any()
]
name, at = present[len(present) // 2]
world = street.state(at)
before = world.render(camera).image
pose = world.actors[name].pose
world.remove(name)
without = world.render(camera).image
beside = street.state(at)
pose[:3, 3] += 2.0 * pose[:3, 1]
beside.actors[name].pose = pose
show(before, without, beside.render(camera).image, titles=("recorded", "removed", "two metres to its left"))

# %% [markdown]
# The same for the whole drive: an edit, whose film `snakemake` renders from an edits file (docs/editing.md).

# %%
stopped = street.edited([{"stop": {"track": name, "at": 0.5 * at}}])
show(stopped.render(camera, at).image, titles=("stopped",))
