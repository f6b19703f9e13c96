"""Particle filters and smoothers, and what is read off them."""
