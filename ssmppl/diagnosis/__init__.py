"""The sim-to-real gap: where a model differs from its data, which effect is missing, and how
much it improves held-out prediction.

effects/    what an unmodelled effect is, the catalogue, candidates: effects bound to an equation
model/      the equations of a model, effects added to them, score columns, one pass over the data
screening/  score tests of all candidates and checks of predictions, with family-wise p-values
selection/  fits and refits, the choice among candidates, equivalence classes
heldout/    the gain ratio on held-out rows or cross-validation blocks, the reference for it
verdict/    the results of all stages, and the decision between the verdicts
report/     tables, words, plots, page, and the model file
run/        checkpoints, failures, seeds, expected time
"""
