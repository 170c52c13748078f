"""Drive folders: a drive as images, LiDAR sweeps and one drive.json, which a person can write (docs/own_data.md)."""
