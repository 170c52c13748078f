"""What runs have cost, what the next one will, and how far the present one is."""
