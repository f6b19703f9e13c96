"""Checks of what a model declares, made where it is traced."""
