"""Measured costs of jobs, estimates of runs, and their progress."""
