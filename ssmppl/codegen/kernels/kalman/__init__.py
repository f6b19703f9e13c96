"""Exact filters and smoothers of linear Gaussian models, in square-root form."""
