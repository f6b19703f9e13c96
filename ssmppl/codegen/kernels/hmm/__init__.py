"""Exact passes over states of finitely many values."""
