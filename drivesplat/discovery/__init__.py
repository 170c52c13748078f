"""Moving objects of a drive that nobody labelled, found in its LiDAR scans."""
