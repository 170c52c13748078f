"""General files and processes: atomic storage, arrays, PLY, PCD, video, HTML templates, locks, prefetching.

It knows no drive and no model, and imports `errors` alone.
"""
