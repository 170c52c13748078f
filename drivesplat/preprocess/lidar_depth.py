"""The stage `lidar_depth`: sparse depth of every training image, from LiDAR.

The returns of the training sweep nearest in time are projected into an image; those of a dynamic object first move with
its box to the image's time. Held-out sweeps contribute nothing, and held-out images get no depth.
"""

import logging

import numpy as np

from drivesplat.lidar.depth import depths_in, nearest_per_pixel, split_sweeps
from drivesplat.lidar.depth_record import PixelDepths
from drivesplat.scene.ego_mask import NO_EGO_MASK, EgoMask
from drivesplat.scene.images import target_size
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import frame_groups
from drivesplat.settings.lidar_depth import LidarDepthJob

log = logging.getLogger(__name__)


def lidar_depths(scene: Scene, job: LidarDepthJob, ego_mask: EgoMask = NO_EGO_MASK) -> list[PixelDepths]:
    """The LiDAR depths of each of the scene's frames, in their order, outside the ego vehicle's body; empty for frames
    outside the training split."""
    clouds, images = split_sweeps(scene, job, ("train",)), []
    for frame, group in zip(scene.frames, frame_groups(scene, job.holdout), strict=True):
        time, interval = frame.timestamp, scene.key_frame_interval
        cloud = min(clouds, key=lambda cloud: abs(cloud.timestamp - time), default=None) if group == "train" else None
        if cloud and abs(cloud.timestamp - time) < interval:
            body = ego_mask.pixels(frame.camera, target_size(frame, job.images))
            images.append(depths_in(scene, frame, cloud, job, body))
        else:
            images.append(nearest_per_pixel(np.empty((0, 3))))
    known = [len(image) for image in images if len(image)]
    log.info("%d depths in %d of %d images", sum(known), len(known), len(images))
    return images
