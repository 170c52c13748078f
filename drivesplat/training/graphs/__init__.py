"""CUDA graphs of training steps, the inputs that they share, and rows preallocated so that they stay valid."""
