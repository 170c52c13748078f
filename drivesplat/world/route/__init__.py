"""Drives of any length through a grid of streets: the route, traffic along it, and the streets near it.

Everything is drawn from seeds of its own place or time, so that a longer drive begins as a shorter one. What one street
has in common with the grid is in `street`.
"""
