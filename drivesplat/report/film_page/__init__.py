"""The template of `index.html`, the page of a scene's films."""
