"""The template of `index.html`, the page of a library of assets."""
