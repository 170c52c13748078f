"""The record of a drive: sensors, frames, tracks, splits, regions."""
