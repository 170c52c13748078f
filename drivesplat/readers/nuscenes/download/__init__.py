"""nuScenes mini from its server into the folder where the config looks for it."""
