"""Bags of ROS 1 and ROS 2 as drive folders: a first look, the map of topics and decisions, and the import."""
