"""Poses over time after an edit: paths of objects and of the ego vehicle, the steps that change them, and samples.

Plain arrays and records: it imports no model and renders nothing.
"""
