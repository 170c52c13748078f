"""One module per rule before training."""
