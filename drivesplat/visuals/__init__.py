"""Pictures, films and tables of trained models beside recordings: ghost panel, removal of a vehicle, comparison of
methods, LiDAR scans, track table.

Metrics of methods are in `evaluation`.
"""
