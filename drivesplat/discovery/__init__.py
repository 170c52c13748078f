"""What moves in a drive that nobody labelled, found in its LiDAR scans."""
