"""From the expressions of a model to compiled code.

    kernels/  the algorithms, as small functions in plain Python: the text that is specialised
    text/     expressions, and kernels specialised to a model, as the text of modules
    modules/  which functions a model needs: one `compile_...` for each family of algorithms
    native/   generated functions compiled without Numba's type inference, called by address
    store/    the folder on disk of generated modules and of what is compiled of them

`modules/program.py` has the `Program` of a model, whose `entry(name)` is what inference calls.
"""
