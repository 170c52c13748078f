"""The command `drivesplat` of an installed copy: runs Snakemake with its workflow, and opens viewer pages. Nothing else
imports it."""
