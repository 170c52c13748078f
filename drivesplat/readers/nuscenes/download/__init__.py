"""The download of nuScenes mini."""
