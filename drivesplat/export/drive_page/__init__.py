"""The page of a whole drive that is cut into blocks: its Jinja template, and the script of its map."""
