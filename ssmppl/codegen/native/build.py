"""LLVM IR -> machine code, kept on disk beside the generated modules -> addresses."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import llvmlite.binding as llvm

from ssmppl.codegen.native.library import function_ir, returned
from ssmppl.codegen.native.machine import described, make_internal, optimise, target
from ssmppl.codegen.native.translate import Untranslatable, translate
from ssmppl.codegen.store import folder
from ssmppl.compiling import one_at_a_time

OLDEST = 16  # LLVM from which pointers have no type, as in the text that is written here
_kept: list[Any] = []  # engines own the code that addresses point to
_built: dict[str, Mapping[str, int]] = {}


@one_at_a_time
def addresses(name: str, text: str) -> Mapping[str, int]:
    """Address of each function of a generated text, compiled or found on disk.

    Raises
    ------
    Untranslatable : the text holds something that only Numba compiles.
    """
    if llvm.llvm_version_info[0] < OLDEST:
        raise Untranslatable(f"LLVM {llvm.llvm_version_info[0]} has typed pointers", fix="")
    try:
        key = f"{name}_{folder.digest_of(text + described())}"
        if key not in _built:
            _built[key] = _load(key, text)
        return _built[key]
    except RuntimeError as error:  # an LLVM that knows another dialect, or not this machine
        raise Untranslatable(f"LLVM refuses: {error}", fix="") from None


def _load(key: str, text: str) -> Mapping[str, int]:
    names, code = None, folder.kept_bytes(key, ".o")
    if code is None:
        with folder.one_process(key):
            code = folder.kept_bytes(key, ".o")
            if code is None:
                code, names = _compiled(text)
                folder.keep_bytes(key, ".o", code)
    if names is None:
        names = [line[4 : line.index("(")] for line in text.splitlines() if line.startswith("def ")]
    module = llvm.parse_assembly(f'target triple = "{llvm.get_process_triple()}"\n')
    engine = llvm.create_mcjit_compiler(module, target())
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    _kept.append(engine)
    found = {n: engine.get_function_address(n) for n in names}
    lost = [n for n, address in found.items() if not address]
    if lost:
        raise Untranslatable(f"the machine code lacks {lost[0]}", fix="")
    return found


def _compiled(text: str) -> tuple[bytes, list[str]]:
    found = translate(text)
    libraries = [function_ir(*call) for call in sorted(found.calls)]
    declared = [_declaration(*call) for call in sorted(found.calls)]
    machine = target()
    head = f'target triple = "{llvm.get_process_triple()}"\n'
    head += f'target datalayout = "{machine.target_data}"\n'
    body = found.text.replace("!GROUP", "!0").replace("!LOOP", "!1")
    metadata = (
        '!0 = distinct !{}\n!1 = distinct !{!1, !2}\n!2 = !{!"llvm.loop.parallel_accesses", !0}\n'
    )
    own = [f"declare double @llvm.{n}.f64(double)" for n in ("fabs", "sqrt")]
    own += [f"declare void @{symbol}(ptr, ptr, i64, i64)" for symbol in sorted(found.simulators)]
    own.append("declare double @llvm.copysign.f64(double, double)")
    module = llvm.parse_assembly("\n".join([head, *own, *declared, body, metadata]))
    for ir in libraries:
        module.link_in(llvm.parse_assembly(ir))
    module.verify()
    make_internal(module, set(found.names))
    optimise(module, 3)
    return machine.emit_object(module), found.names


def _declaration(name: str, arity: int, draws: bool) -> str:
    numbers = ["ptr", "i64"] * draws + ["double"] * arity
    return f"declare {returned(name)} @lib_{name}({', '.join(numbers)})"
