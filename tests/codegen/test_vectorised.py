"""The passes over particles that the ice varves need come out as vector instructions."""

import re

import numpy as np
import pytest
from llvmlite import binding

from ssmppl.analysis.density import Missing
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.codegen.modules.program import compile_trace
from ssmppl.language.tracing import trace
from tests.models.statements import build

PACKED = re.compile(r"\bv(?:mul|add|sub|fn?m(?:add|sub)\d+)pd\b.*%[yz]mm")
PASSES = [("bootstrap", "draw"), ("bootstrap", "weigh")] + [
    ("auxiliary", role) for role in ("fit", "look_ahead", "draw", "weigh")
]

pytestmark = pytest.mark.skipif(
    not binding.get_host_cpu_features().get("avx2", False), reason="the CPU has no AVX2"
)


@pytest.mark.parametrize(("proposal", "role"), PASSES)
def test_passes_of_the_varves_vectorise(proposal, role):
    program = compile_trace(trace(build("varves")), Missing(none=True))
    n, theta = 100, np.array([0.95, 50.0])
    c, s, log_w = np.zeros(20), np.ones(20), np.zeros(n)
    x_prev, x, fits = np.zeros((1, n)), np.zeros((1, n)), np.ones((2, n))
    noise, rng = np.full(2 * n, 0.5), new_state(np.random.SeedSequence(1))
    arguments = {
        "fit": (x_prev, fits),
        "look_ahead": (x_prev, fits, log_w),
        "draw": (x_prev, fits, x, noise, noise, rng),
        "weigh": (x_prev, fits, x, log_w),
    }
    run = program.entry(f"{role}_{proposal}")
    run(theta, c, s, *arguments[role])
    (assembly,) = run.inspect_asm().values()
    assert PACKED.search(assembly)
