"""The stage `train`: loop, losses, densification, CUDA graphs, logs and resume state. It renders with `model`, and
reads no dataset."""
