"""The page of gap_report.html: its Jinja template with its style, and its script."""
