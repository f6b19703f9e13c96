"""The folder on disk of generated modules and of what is compiled of them."""
