"""A probabilistic-programming language for state space models."""

__version__ = "0.1.0"
