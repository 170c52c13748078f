"""Edits of a recorded drive: changed motion of actors and of the ego vehicle."""
