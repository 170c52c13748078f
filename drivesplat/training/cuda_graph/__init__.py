"""Training iterations as CUDA graphs: replays, and the rows preallocated for them."""
