"""Where a result comes from: provenance records and code digests."""
