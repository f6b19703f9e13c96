"""The sim-to-real gap: where a model differs from its data, which effect is missing, what it buys.

effects/    what an unmodelled effect is, the catalogue, an effect with its shape in numbers
model/      effects bound to the equations of a model and added; one pass over the data
screening/  all candidates and checks from one set of simulations, with family-wise p-values
selection/  fits and refits of what leads, the choice, what cannot be told apart
heldout/    how far the gap closes on rows that took no part
report/     tables, words, plots, page, and the model file
run/        checkpoints, parts that failed, the time that is expected
"""
