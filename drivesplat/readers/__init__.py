"""Readers of datasets into `Scene` records. No other package knows a dataset's files or class names.

`datasets` and `sweeps` name the modules that locate the files, read the tables and read the sweeps of each dataset.
"""
