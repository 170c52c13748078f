"""The command `drivesplat` of an installed copy: the workflow without a checkout."""
