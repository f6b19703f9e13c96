"""Functions of a random or given model, called as native code and as plain Python."""

import ctypes
from functools import partial

import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.codegen.modules.program import compile_trace
from ssmppl.codegen.native.build import addresses
from ssmppl.codegen.native.translate import PLANES
from tests.codegen.harness import PARTICLES, ROOM, STEPS, plain_module


def called(address, names, values):
    """Call a native function with these arguments."""
    words = np.zeros(2 * len(names), dtype=np.int64)
    for k, name in enumerate(names):
        value = values[name]
        if isinstance(value, int):
            words[2 * k] = value
            continue
        assert value.flags.c_contiguous
        words[2 * k] = value.ctypes.data
        words[2 * k + 1] = value.shape[1 if name in PLANES else 0]
    ctypes.CFUNCTYPE(None, ctypes.c_void_p)(address)(words.ctypes.data)


def arguments(numbers, t, rng):
    """An array for every argument that a generated function can have."""
    d = len(numbers.traced.state_symbols)
    return {
        "theta": numbers.theta, "c": np.zeros(ROOM), "s": np.zeros(ROOM), "t": t,
        "y_data": numbers.y, "seen_data": numbers.seen, "u_data": numbers.u,
        "states": numbers.states[t].copy(), "states_prev": numbers.states[max(t - 1, 0)].copy(),
        "fits": rng.uniform(0.5, 1.5, (ROOM, PARTICLES)), "log_w": rng.normal(size=PARTICLES),
        "out": rng.normal(size=(ROOM, PARTICLES)), "noise": rng.normal(size=ROOM),
        "reference": np.ascontiguousarray(numbers.states[t, :, 2]) if d else np.zeros(0),
        "normals": rng.normal(size=ROOM * PARTICLES), "uniforms": rng.uniform(size=ROOM),
        "rng": new_state(np.random.SeedSequence(3)), "steps": STEPS,
        "trajectory": np.ascontiguousarray(numbers.states[:, :, 2]), "total": rng.normal(size=ROOM),
        "z": rng.normal(size=ROOM), "free": np.arange(ROOM) % 3 > 0,
    }  # fmt: skip


def copied(values):
    return {k: v if isinstance(v, int) else v.copy() for k, v in values.items()}


def rounded(function, names, values, wanted):
    """What a function leaves in an argument if its numbers are a rounding off."""
    rng, twin = np.random.default_rng(1), copied(values)
    for name, value in twin.items():
        if not isinstance(value, int) and value.dtype == float and not name.endswith("_data"):
            off = np.where(value == np.round(value), 0, rng.choice((-1, 1), value.shape))
            value *= 1.0 + 2.0**-52 * off  # whole numbers may be of discrete states
    with np.errstate(all="ignore"):
        function(*(twin[n] for n in names))
    return twin[wanted]


def sections(traced, gaps):
    """A model's generated module in plain Python, and (name, section, text) of each part."""
    program = compile_trace(traced, Missing(none=not gaps))
    found = {}
    for algorithm in program.loaded._out.algorithms.values():
        found[algorithm.section.suffix] = algorithm.section
    parts = [
        (f"{traced.name}_{suffix}", section, program.loaded._out.texts[id(section)])
        for suffix, section in found.items()
    ]
    return plain_module(program.module), parts


def both_ways(plain, name, section, text, numbers, rng):
    """For every function of a section (what it is, native numbers, plain numbers, a function that
    gives plain numbers again, of arguments that are a rounding off), by argument."""
    found = addresses(name, text)
    for t in (0, STEPS - 1):
        values = arguments(numbers, t, rng)
        for role in sorted(section.roles, key=lambda r: (r != "prepare", r != "step")):
            names = section.roles[role].split(", ")
            if t == 0 and "states_prev" in names:
                continue
            before, twin = copied(values), copied(values)
            called(found[section.name(role)], names, values)
            with np.errstate(all="ignore"):
                getattr(plain, section.name(role))(*(twin[n] for n in names))
            for n in set(names) - {"t", "steps"}:
                near = partial(rounded, getattr(plain, section.name(role)), names, before, n)
                yield f"{section.name(role)}, {n}, t={t}", values[n], twin[n], near
