"""Climbing a function: Newton steps by differences, quadratics fitted to noisy values."""
