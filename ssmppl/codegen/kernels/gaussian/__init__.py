"""Kernels of the Gaussian approximation to the smoothing problem."""
