"""Measurements of the workflow: quality of recipes, training speed, and rendering speed."""
