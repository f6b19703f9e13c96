"""What users add to the language: distributions by their log densities, and compiled functions."""
