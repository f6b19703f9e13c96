"""Distributions of vectors and matrices that stand on those of `multivariate.py`."""
