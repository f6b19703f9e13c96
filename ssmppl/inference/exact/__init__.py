"""Linear Gaussian models, without Monte Carlo error."""
