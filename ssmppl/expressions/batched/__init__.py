"""Functions of Python that move a batch, as nodes: their values and derivatives by differences."""
