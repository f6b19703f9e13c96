"""What is decided before a method runs: which one, which proposal, and where it begins."""
