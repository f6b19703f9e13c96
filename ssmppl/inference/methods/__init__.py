"""Methods as settings: small frozen dataclasses, and what they ask of a model."""
