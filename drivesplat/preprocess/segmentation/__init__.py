"""Class maps, sky masks and vehicle masks of a scene's images by a segmentation network: label sets, networks and their
weights, and the stage `segment`. The stage `masks` reads the maps as it reads a user's own."""
