"""The generated modules of a model: one function `compile_...` for each family of algorithms."""
