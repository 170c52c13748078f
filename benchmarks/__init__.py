"""Measurements of the workflow: quality of recipes, speed of training and rendering, and faults that the tests find.
The library does not import it."""
