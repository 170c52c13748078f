"""Measurements of the workflow: quality of recipes, speed of training and rendering, and what the tests find."""
