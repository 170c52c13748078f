"""The sensor service: trained drives as the renderer of AlpaSim, over gRPC.

`drivesplat serve` (docs/simulators.md) starts a `SensorServer`. Messages are checked and answered here; all images and
scans come from `drivesplat.drive`. The packages of the extra `serve` are needed to start a server only.
"""
