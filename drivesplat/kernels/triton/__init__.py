"""Triton kernels for the GPU: fewer and larger passes than torch's, equal to them within rounding."""
