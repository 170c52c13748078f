"""The street of a synthetic world: its road, and where objects stand, walk and drive. Meshes come from `shapes`."""
