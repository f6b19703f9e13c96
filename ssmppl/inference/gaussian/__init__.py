"""The Gaussian approximation of the states, over all experiments of a problem."""
