"""The sim-to-real gap: where a model differs from its data, which effect is missing, what it buys.

Effects, from their declaration to a model file:

    effect.py      what an unmodelled effect is; declared.py: that a declaration fits its function
    catalogue.py   the effects that are looked for: catalogue_motion, _input, _sensor
    anatomy.py     the equations of a model, and which state is the integral of which
    candidates.py  which effects apply to a model, their shapes in numbers (scales.py)
    binding.py     an effect's function called with the symbols of an equation
    augment.py     a model with effects added, by changes of its laws (laws.py)
    writing.py     a traced model as a model file, its expressions as text (spelling.py, terms.py)
"""
