"""Training iterations as CUDA graphs, and the rows preallocated for them."""
