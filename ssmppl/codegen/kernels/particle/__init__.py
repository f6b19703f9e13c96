"""Particle filters, conditional SMC and backward simulation, over a model's functions."""
