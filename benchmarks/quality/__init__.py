"""Comparison of recipes: each trained on one scene with several random seeds, in one table."""
