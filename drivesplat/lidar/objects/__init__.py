"""Moving objects that nobody labelled, found in the LiDAR scans of a drive: clusters, chains, boxes, tracks."""
