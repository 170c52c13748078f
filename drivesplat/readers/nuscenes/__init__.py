"""nuScenes: tables into a Scene, and the download of nuScenes mini."""
