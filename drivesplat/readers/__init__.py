"""Datasets into `Scene` records, one package each. Nothing downstream knows a dataset's files or class names.

`datasets` and `sweeps` name the modules of each package that find its files, read its tables and read a sweep.
"""
