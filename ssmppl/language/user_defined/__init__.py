"""What users add to the language: laws by their log densities, and compiled functions."""
