"""Every pose over time: motions of tracks, paths of cameras and of the ego vehicle, and what the steps of an edit
make of them.

Plain arrays and records: it imports no model and renders nothing.
"""
