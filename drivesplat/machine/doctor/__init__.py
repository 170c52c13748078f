"""Diagnosis of this machine: what the workflow can use, and how to fix the rest (`make doctor`).

`torch_builds`: GPUs, drivers and builds of torch; standard library only, since set-up runs it before any package is
installed. `facts`: everything found out, in one record. `checks`: findings from facts, pure functions.
"""
