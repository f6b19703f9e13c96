"""Scalar functions for translated code: the kernels' own and primitives, as LLVM IR by Numba.

Each of them is compiled by Numba once, and its IR kept on disk; translated code takes it in and
inlines it, so that a loop that calls exp still vectorises. Of the user's primitives those are taken
in that need nothing of Python at run time: no exception to be raised, no memory to be managed, no
address of this process.
"""

from __future__ import annotations

import importlib
import re
from typing import Any

import llvmlite.binding as llvm
import numba
from numba import float64, types

from ssmppl.codegen.native.machine import make_internal, optimise
from ssmppl.codegen.native.translate import Untranslatable
from ssmppl.codegen.store import folder
from ssmppl.compiling import once
from ssmppl.expressions.operations import KERNELS, MATRIX_OPS
from ssmppl.language.user_defined.primitive import REGISTRY, outputs_of

STREAM = types.Array(types.uint64, 1, "C")


@once
def function_ir(name: str, arity: int, draws: bool) -> str:
    """IR that defines `double @lib_<name>(double, ...)` and all that it needs.

    draws : the function's first argument is a stream of random numbers: its address and length.

    Raises
    ------
    Untranslatable : there is no such function of floats.
    """
    primitive = name in REGISTRY and not draws
    if not primitive and (name not in KERNELS or name in MATRIX_OPS):  # of tuples, and of arrays
        raise Untranslatable(f"{name} is not a function of numbers", fix="")
    file = f"lib_{name}_{arity}"
    text = folder.kept(file, ".ll")
    if text is None:
        with folder.one_process(file):
            text = folder.kept(file, ".ll")
            if text is None:
                text = _of_primitive(name, arity) if primitive else _made(name, arity, draws)
                folder.keep(file, ".ll", text)
    return text


def _made(name: str, arity: int, draws: bool) -> str:
    module = importlib.import_module(f"ssmppl.codegen.kernels.math.{KERNELS[name]}")
    dispatcher: Any = getattr(getattr(module, name), "bare", None)
    if dispatcher is None:  # Numba is switched off
        raise Untranslatable(f"{name} is not compiled", fix="")
    compiled = _compiled(dispatcher, name, arity, draws)
    text = compiled.library.get_llvm_str()
    return _wrapped(text, compiled.fndesc.llvm_func_name, name, arity, draws)


def _compiled(dispatcher: Any, name: str, arity: int, draws: bool = False) -> Any:
    signature = (*([STREAM] if draws else []), *[float64] * arity)
    dispatcher.compile(signature)
    compiled = dispatcher.overloads[signature]
    several = outputs_of(name)
    wanted = float64 if several == 1 else types.UniTuple(float64, several)
    if compiled.signature.return_type != wanted:
        raise Untranslatable(f"{name} gives {compiled.signature.return_type}", fix="")
    return compiled


def _of_primitive(name: str, arity: int) -> str:
    made: Any = REGISTRY[name].compiled
    options: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
    options |= {k: v for k, v in made.targetoptions.items() if k != "nopython"}
    compiled = _compiled(numba.njit(**options)(made.py_func), name, arity)
    inner = compiled.fndesc.llvm_func_name
    module = llvm.parse_assembly(compiled.library.get_llvm_str())
    # Within one module LLVM sees that what it calls never raises: then it returns the constant 0.
    make_internal(module, {inner})
    optimise(module, 1)
    text = str(module)
    symbol = re.escape(_quoted(inner))
    (body,) = re.findall(rf"^define [^\n]*@{symbol}\(.+?^}}", text, re.MULTILINE | re.DOTALL)
    returned = re.findall(r"^ +ret i32 ([^,\n]+)", body, re.MULTILINE)
    outside = [
        x.name for x in (*module.functions, *module.global_variables)
        if x.is_declaration and not x.name.startswith("llvm.")
    ]  # fmt: skip
    if set(returned) != {"0"}:
        raise Untranslatable(f"{name} may raise an exception", fix="")
    if compiled.library.has_dynamic_globals or not all(map(_of_libm, outside)):
        raise Untranslatable(f"{name} needs {', '.join(outside) or 'addresses'}", fix="")
    # Numba counts functions up in each process: their names are no names for others.
    module = llvm.parse_assembly(_wrapped(text, inner, name, arity, False))
    make_internal(module, {f"lib_{name}"})
    return str(module)


def _of_libm(name: str) -> bool:
    return re.fullmatch("[a-z][a-z0-9]*", name) is not None and bool(llvm.address_of_symbol(name))


def _wrapped(text: str, inner: str, name: str, arity: int, draws: bool) -> str:
    """The text of a function that Numba compiled, and of one that calls it by floats alone."""
    numbers = [f"double %x{k}" for k in range(arity)]
    # An array goes to Numba's functions as (parent, owner, items, item size, data, shape, stride).
    array = ["ptr null", "ptr null", "i64 %n", "i64 8", "ptr %rng", "i64 %n", "i64 8"]
    given = ", ".join([*(["ptr %rng", "i64 %n"] if draws else []), *numbers])
    passed = ", ".join(["ptr %out", "ptr %fault", *(array if draws else []), *numbers])
    kind = returned(name)
    wrapper = f"""
define linkonce_odr {kind} @lib_{name}({given}) alwaysinline nounwind {{
  %out = alloca {kind}
  %fault = alloca ptr
  %status = call i32 @{_quoted(inner)}({passed})
  %value = load {kind}, ptr %out
  ret {kind} %value
}}
"""
    return text + wrapper


def returned(name: str) -> str:
    """The type in IR of what a function gives."""
    several = outputs_of(name)
    return "double" if several == 1 else f"[{several} x double]"


def _quoted(name: str) -> str:
    return name if re.fullmatch(r"[\w.$]+", name) else f'"{name}"'
