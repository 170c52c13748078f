"""Records of a drive: `Scene` with sensors, frames, sweeps and tracks; masks, splits, regions, the training record;
rigid motion and lenses.

It knows no dataset and no model, and imports `errors`, `io` and `settings` alone.
"""
