"""The page of viewer.html: its Jinja template, and the scripts that it includes one after the other."""
