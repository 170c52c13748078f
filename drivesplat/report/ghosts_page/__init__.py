"""The template of ghosts.html."""
