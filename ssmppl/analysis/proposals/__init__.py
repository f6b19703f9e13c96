"""How particles move: the proposals that are derived from a model."""
