"""The stages before training, a module per rule: scene, masks, seeds, actors, LiDAR depth, training record. It imports
no model."""
