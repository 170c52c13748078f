"""Where a result comes from: provenance records, and digests of code, syntax and files."""
