"""The verdicts that a report can give, and what its share is of where no effect was chosen."""

EFFECT = "effect"
NONE_OF_THESE = "none of these"
NO_GAP = "no measurable gap"
VERDICTS = (EFFECT, NONE_OF_THESE, NO_GAP)

CURVES = "smooth functions of states and inputs"  # what closes the gap where no effect was chosen
