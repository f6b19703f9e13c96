"""A traced model with effects bound to its equations and added, and one pass of it over data."""
