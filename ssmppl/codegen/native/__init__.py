"""Generated functions compiled without Numba's type inference, which is where its time goes.

    translate.py  the text of a generated function -> LLVM IR, a statement at a time
    arithmetic.py its expressions
    matrices.py   operations on small matrices among them
    library.py    the scalar functions that such text calls, as Numba compiles them, once for all
    build.py      IR -> machine code, kept on disk -> addresses
    entries.py    Numba's kernels, compiled once for all models, that call functions by address
    loading.py    a generated module with its algorithms, by either way

The text stays the one definition: what cannot be translated is compiled by Numba as it stands.
"""
