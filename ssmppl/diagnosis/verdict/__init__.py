"""The results of all stages in one object, and the verdict that they give."""
