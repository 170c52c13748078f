"""Measurements of the workflow: quality of recipes, training speed, rendering speed. The library does not import it."""
