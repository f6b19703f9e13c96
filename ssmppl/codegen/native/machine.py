"""The processor that machine code is for, and LLVM's optimiser for it."""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm

from ssmppl.compiling import once


@once
def target() -> Any:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    found = llvm.Target.from_default_triple()
    return found.create_target_machine(
        cpu=llvm.get_host_cpu_name(), features=llvm.get_host_cpu_features().flatten(), opt=3,
        jit=True,
    )  # fmt: skip


def described() -> str:
    """What compiled code depends on beside its text."""
    return f"{llvm.get_host_cpu_name()} {llvm.get_host_cpu_features().flatten()}"


def optimise(module: Any, level: int) -> None:
    """Run LLVM's passes of a level, 1 to 3, over a module; the third with vectorised loops."""
    options = llvm.create_pipeline_tuning_options(speed_level=level)
    options.loop_vectorization = level == 3
    options.slp_vectorization = False
    builder = llvm.create_pass_builder(target(), options)
    builder.getModulePassManager().run(module, builder)


def make_internal(module: Any, public: set[str]) -> None:
    """Let only the functions of these names be seen from outside of the module."""
    for f in module.functions:
        if f.name not in public and not f.is_declaration:
            f.linkage = llvm.Linkage.internal
