"""Scalar functions for translated code: the kernels' own, as LLVM IR that Numba made of them.

Each is compiled by Numba once, and its IR kept on disk; translated code takes it in and inlines it,
so that a loop that calls exp still vectorises.
"""

from __future__ import annotations

import importlib
import re
from typing import Any

from numba import float64, types

from ssmppl.codegen.native.translate import Untranslatable
from ssmppl.codegen.store import folder
from ssmppl.compiling import once
from ssmppl.expressions.operations import KERNELS, MATRIX_OPS

STREAM = types.Array(types.uint64, 1, "C")


@once
def function_ir(name: str, arity: int, draws: bool) -> str:
    """IR that defines `double @lib_<name>(double, ...)` and all that it needs.

    draws : the function's first argument is a stream of random numbers: its address and length.

    Raises
    ------
    Untranslatable : there is no such function of floats.
    """
    if name not in KERNELS or name in MATRIX_OPS:  # these take tuples, and give arrays
        raise Untranslatable(f"{name} is not a function of numbers", fix="")
    file = f"lib_{name}_{arity}"
    text = folder.kept(file, ".ll")
    if text is None:
        with folder.one_process(file):
            text = folder.kept(file, ".ll") or _made(name, arity, draws)
            folder.keep(file, ".ll", text)
    return text


def _made(name: str, arity: int, draws: bool) -> str:
    module = importlib.import_module(f"ssmppl.codegen.kernels.math.{KERNELS[name]}")
    dispatcher: Any = getattr(getattr(module, name), "bare", None)
    if dispatcher is None:  # Numba is switched off
        raise Untranslatable(f"{name} is not compiled", fix="")
    signature = (*([STREAM] if draws else []), *[float64] * arity)
    dispatcher.compile(signature)
    compiled = dispatcher.overloads[signature]
    if compiled.signature.return_type != float64:
        raise Untranslatable(f"{name} gives {compiled.signature.return_type}", fix="")
    inner = compiled.fndesc.llvm_func_name
    numbers = [f"double %x{k}" for k in range(arity)]
    # An array goes to Numba's functions as (parent, owner, items, item size, data, shape, stride).
    array = ["ptr null", "ptr null", "i64 %n", "i64 8", "ptr %rng", "i64 %n", "i64 8"]
    given = ", ".join([*(["ptr %rng", "i64 %n"] if draws else []), *numbers])
    passed = ", ".join(["ptr %out", "ptr %fault", *(array if draws else []), *numbers])
    wrapper = f"""
define linkonce_odr double @lib_{name}({given}) alwaysinline nounwind {{
  %out = alloca double
  %fault = alloca ptr
  %status = call i32 @{_quoted(inner)}({passed})
  %value = load double, ptr %out
  ret double %value
}}
"""
    return compiled.library.get_llvm_str() + wrapper


def _quoted(name: str) -> str:
    return name if re.fullmatch(r"[\w.$]+", name) else f'"{name}"'
