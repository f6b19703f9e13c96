"""Models that call a simulator, many parameter vectors at a time: one call of it a row."""
