"""Methods of maximisation; each has `climb(setup, method)`."""
