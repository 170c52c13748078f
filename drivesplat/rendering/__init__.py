"""Films and frames from trained models, along trajectories."""
