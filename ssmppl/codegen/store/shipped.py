"""Machine code that a wheel carries: of kernels that all models share, compiled for a level of
processors, x86-64-v3 (AVX2) or x86-64-v4 (AVX-512), and not for the machine that built it.

Sums over particles are in an order that goes by the width of the vectors, which LLVM chooses by the
processor: with AVX-512 half the registers on Intel's, the whole on AMD's. So there is code for
either, and the numbers are those of code that is compiled here.

An archive is one file for a target: a first line with the number of bytes of the index and its
digest, the index, a JSON object, then the entries, each compressed by itself. The index says for
what all of it was compiled; an archive for anything else is left alone, and so is an entry whose
digest is not that of the index. What is not found is compiled, as from source.

Nothing is ever written here but by `write`, when a wheel is built.
"""

from __future__ import annotations

import hashlib
import json
import lzma
import platform
from collections.abc import Mapping, Set
from functools import cache
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numba
import numpy as np

FOLDER = Path(__file__).with_name("machine_code")
SUFFIX = ".archive"
# What each level has beyond those below it, by LLVM's names (x86-64 psABI, section 3.1.1); the
# best first.
LEVELS = {
    "x86-64-v4": ("avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"),
    "x86-64-v3": ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"),
    "x86-64-v2": ("cx16", "popcnt", "sse3", "sse4.1", "sse4.2", "ssse3"),
}
# What a wheel has code for: LLVM's name of the processor, and features besides.
TARGETS = {
    "x86-64-v3": ("x86-64-v3", ""),
    "x86-64-v4": ("x86-64-v4", ""),
    "x86-64-v4-wide": ("x86-64-v4", "-prefer-256-bit"),
}
WIDE = "znver"  # begins LLVM's names of processors that take whole registers
taken: list[str] = []
"""Names of the entries that this process had from an archive, in order."""


def built_for(kernels: str) -> dict[str, str]:
    """What code has to be compiled with, to run here: kernels is the digest of their text."""
    return {
        "kernels": kernels,
        "python": ".".join(platform.python_version_tuple()[:2]),
        "numpy": ".".join(np.__version__.split(".")[:2]),
        "numba": numba.__version__,
        "llvmlite": llvmlite.__version__,
        "triple": llvm.get_process_triple(),
    }


def find(name: str, kernels: str) -> bytes | None:
    """An entry for this processor and these kernels; None where there is none that is whole."""
    target = _target()
    if target is None:
        return None
    path = FOLDER / f"{target}{SUFFIX}"
    index, begin = _index(path)
    where = index.get("entries", {}).get(name)
    if where is None or index["built for"] != built_for(kernels):
        return None
    try:
        with path.open("rb") as file:
            file.seek(begin + where[0])
            packed = file.read(where[1])
        if hashlib.sha256(packed).hexdigest() != where[2]:
            return None
        found = lzma.decompress(packed)
    except (OSError, lzma.LZMAError):
        return None
    taken.append(name)
    return found


def write(path: Path, entries: Mapping[str, bytes], kernels: str) -> None:
    """An archive of these entries, compiled by this process, of kernels with this digest."""
    where, parts, at = {}, [], 0
    for name in sorted(entries):
        packed = lzma.compress(entries[name], preset=9)
        where[name] = at, len(packed), hashlib.sha256(packed).hexdigest()
        parts.append(packed)
        at += len(packed)
    index = json.dumps({"built for": built_for(kernels), "entries": where}).encode()
    path.parent.mkdir(parents=True, exist_ok=True)
    head = f"{len(index)} {hashlib.sha256(index).hexdigest()}\n".encode()
    path.write_bytes(b"".join([head, index, *parts]))


@cache
def _index(path: Path) -> tuple[dict[str, Any], int]:
    """The index of an archive and where its entries begin; an empty one where it is not whole."""
    try:
        with path.open("rb") as file:
            size, digest = file.readline(100).decode().split()
            text = file.read(int(size))
            begin = file.tell()
    except (OSError, ValueError):
        return {}, 0
    if hashlib.sha256(text).hexdigest() != digest:
        return {}, 0
    return json.loads(text), begin


@cache
def _target() -> str | None:
    """The target whose code is taken; None where Numba is told to compile for another processor."""
    config: Any = numba.config
    if config.CPU_NAME is not None or config.CPU_FEATURES is not None or not FOLDER.is_dir():
        return None
    return target_here()


def target_here() -> str | None:
    """The target that this processor is; None where there is none."""
    has = {name for name, there in llvm.get_host_cpu_features().items() if there}
    return target_of(has, llvm.get_host_cpu_name())


def target_of(features: Set[str], processor: str) -> str | None:
    """The target of a processor with these features and this name, both LLVM's; None for none."""
    reached = None
    for level in reversed(LEVELS):
        if not features >= set(LEVELS[level]):
            break
        reached = level
    if reached == "x86-64-v4" and processor.startswith(WIDE):
        return "x86-64-v4-wide"
    return reached if reached in TARGETS else None
