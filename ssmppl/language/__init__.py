"""The language: distributions, models and their traces."""
