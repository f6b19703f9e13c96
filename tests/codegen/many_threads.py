"""Many threads make many models at once, into an empty cache: see test_threads.py.

    SSMPPL_CACHE=<an empty folder> python -m tests.codegen.many_threads

Every collection of garbage, of which there are many, lets another thread go on: also one in the
middle of Python's parser, as happens once in many hours without. Prints what went wrong in any
thread; where threads wait for each other, the process ends with the stacks of all.
"""

from __future__ import annotations

import faulthandler
import gc
import sys
import threading
import time
import traceback
from itertools import pairwise

import numba
import numpy as np

from ssmppl.analysis.density import Missing
from ssmppl.codegen.modules.program import Program, compile_trace
from ssmppl.codegen.native.build import addresses
from ssmppl.codegen.native.translate import Untranslatable
from ssmppl.language.tracing import trace
from tests.models.statements import MODELS

NAMES = ("linear_vector", "wishart_noise", "matrices", "pendulum", "switching", "linear_scalar")
THREADS = 8
PATIENCE = 300.0  # seconds after which threads are taken to wait for each other


def work(
    number: int, models: list, start: threading.Barrier, made: dict, errors: list[str]
) -> None:
    """What a task of `run_tasks` does with a new model, until its first pass over data."""
    start.wait()
    try:
        if number % 4 == 0:  # Numba alone, which parses too where there are expressions of arrays
            numba.njit(lambda v: 2.0 * v + number)(np.ones(2))
        for model in models:
            program = compile_trace(trace(model), Missing())
            made.setdefault(id(model), []).append(things_of(program))
    except BaseException:
        errors.append(traceback.format_exc())


def things_of(program: Program) -> list:
    """What is one object, whoever asks for it."""
    found = [program, program.module, program.twisted, program.marginal, program.tempered]
    for text in program.loaded._out.texts.values():
        try:
            found.append(addresses("section", text))
        except Untranslatable:
            continue
    return found


def main() -> int:
    faulthandler.dump_traceback_later(PATIENCE, exit=True)
    models = [MODELS[name]() for name in NAMES]
    start, made, errors = threading.Barrier(THREADS), dict[int, list](), list[str]()
    orders = [models[k % len(models) :] + models[: k % len(models)] for k in range(THREADS)]
    threads = [
        threading.Thread(target=work, args=(k, own, start, made, errors))
        for k, own in enumerate(orders)
    ]
    gc.freeze()
    gc.callbacks.append(lambda phase, info: time.sleep(0))
    gc.set_threshold(100, 1000, 1000)
    sys.setswitchinterval(1e-6)
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for each in made.values():
        for one, other in pairwise(each):
            if [*map(id, one)] != [*map(id, other)]:
                errors.append(f"made twice: one of {[type(t).__name__ for t in one]}")
    print("\n".join(errors), file=sys.stderr)
    return 1 if errors else 0


if __name__ == "__main__":
    sys.exit(main())
