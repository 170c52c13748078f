"""Files: atomic storage, PLY, video, HTML templates; prefetching."""
