"""How far the gap closes on rows that took no part in fitting or choosing."""
