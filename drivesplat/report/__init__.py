"""The report across scenes: the gap between static and moving pixels, as records, a table, a plot and a page."""
