"""The gain on held-out rows, which took no part in fitting or choosing."""
