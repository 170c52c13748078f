"""Files of a synthetic world: nuScenes tables, class maps, ground truth."""
