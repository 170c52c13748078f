"""Edits of a recorded drive: objects, and the camera's car, that move otherwise than they did."""
