"""Loops as nodes: maps applied again and again, whose text and compile time do not grow with how
often; differential equations in small steps, and the exponential of a matrix, are made of them."""
