"""Digests and states of code: what a rule and a kernel cache depend on."""
