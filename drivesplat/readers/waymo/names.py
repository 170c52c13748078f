"""Names of Waymo's sensors and components by their numbers. Planning imports this: nothing heavy.

Numbers are those of `CameraName`, `LaserName` and `CameraCalibration.RollingShutterReadOutDirection` in
waymo_open_dataset/dataset.proto of github.com/waymo-research/waymo-open-dataset (`LaserName` TOP is 1).
"""

CAMERAS = {1: "FRONT", 2: "FRONT_LEFT", 3: "FRONT_RIGHT", 4: "SIDE_LEFT", 5: "SIDE_RIGHT"}
LASERS = {1: "TOP", 2: "FRONT", 3: "SIDE_LEFT", 4: "SIDE_RIGHT", 5: "REAR"}
TOP = 1
"""The laser whose range images have a pose for each pixel."""
READOUT_DIRECTIONS = {1: "down", 2: "right", 3: "up", 4: "left"}
GLOBAL_SHUTTER = 5

V1, V2 = "v1", "v2"
COMPONENTS = (
    "camera_image", "camera_calibration", "vehicle_pose", "lidar", "lidar_calibration", "lidar_pose", "lidar_box",
)  # fmt: skip
"""Folders of a v2 dataset that are read."""
SEGMENTATION = "camera_segmentation"
"""A component that is read where it is there."""
UNDEFINED_CLASS, SKY_CLASS, MAX_CLASS = 0, 25, 28
"""`CameraSegmentation.Type` in protos/camera_segmentation.proto of the same repository."""
FRAMES = "frames"
"""What a v1 segment's only file holds."""
