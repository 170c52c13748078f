"""Assets of other programs: one module per format, which finds the assets in its files and writes them. What becomes
of them is decided in `drivesplat.editing.assets.exchange`."""
