"""Fits of the model and of its augmentations: the mode, bounds, noisy climbs."""
