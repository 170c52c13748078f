"""Closed loop: a policy drives in a trained drive. The environment, other traffic, scores, and how far images can be
trusted."""
