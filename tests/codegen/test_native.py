"""Native code does what the text says: every function of the corpus, and the small language."""

import ctypes
import itertools
import re

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.analysis.density import Missing
from ssmppl.codegen import cache
from ssmppl.codegen.kernels.random import new_state
from ssmppl.codegen.loading import Loaded
from ssmppl.codegen.native import build as native_build
from ssmppl.codegen.native.library import HOMES
from ssmppl.codegen.native.translate import PLANES, Untranslatable, translate
from ssmppl.codegen.program import compile_trace
from ssmppl.inference.problem import pose
from ssmppl.language.trace import trace
from tests.codegen.harness import PARTICLES, ROOM, STEPS, Numbers, plain_module
from tests.codegen.models import MODELS, build

pytestmark = pytest.mark.skipif(
    native_build.llvm.llvm_version_info[0] < native_build.OLDEST,
    reason="this LLVM has typed pointers, and Numba compiles everything",
)

MATRIX = re.compile(r"\b(cholesky|inverse|logdet|det)\(\(")  # what is left to Numba


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
        "rng": new_state(np.random.SeedSequence(3)),
    }  # fmt: skip


def copied(values):
    return {k: v if isinstance(v, int) else v.copy() for k, v in values.items()}


CASES = [(name, name != "varves") for name in MODELS]  # with guards for gaps, and once without


@pytest.mark.parametrize(("name", "gaps"), CASES, ids=[name for name, _ in CASES])
def test_every_function_of_the_corpus(name, gaps):
    """Native and interpreted functions leave the same numbers in all their arguments."""
    traced = trace(build(name))
    program = compile_trace(traced, Missing(none=not gaps))
    rng = np.random.default_rng(4)
    numbers = Numbers(traced, rng, gaps)
    plain, sections = plain_module(program.module), {}
    for algorithm in program.loaded._out.algorithms.values():
        sections[algorithm.section.suffix] = algorithm.section
    done = 0
    for suffix, section in sections.items():
        text = program.loaded._out.texts[id(section)]
        if MATRIX.search(text):
            with pytest.raises(Untranslatable):
                native_build.addresses(f"{traced.name}_{suffix}", text)
            continue
        found = native_build.addresses(f"{traced.name}_{suffix}", text)
        for t in (0, STEPS - 1):
            values = arguments(numbers, t, rng)
            order = ["prepare", "step", *(r for r in section.roles if r not in ("prepare", "step"))]
            for role in order:
                names = section.roles[role].split(", ")
                if t == 0 and "states_prev" in names:
                    continue
                twin = copied(values)
                called(found[section.name(role)], names, values)
                with np.errstate(all="ignore"):
                    getattr(plain, section.name(role))(*(twin[n] for n in names))
                for n in set(names) - {"t"}:
                    np.testing.assert_allclose(
                        values[n], twin[n], rtol=1e-12, atol=1e-13, err_msg=f"{role} {n} t={t}"
                    )
                done += 1
    assert done or MATRIX.search(program.source())


ODD = [0.0, -0.0, 1.0, -1.0, 0.3, -2.5, 7.0, 1e300, -1e300, np.inf, -np.inf, np.nan]
EXPRESSIONS = [
    "a + b", "a - b", "a * b", "a / b", "a % b", "-a", "abs(a)", "a if b else 2.0",
    "a if a < b else b", "a if a <= b and b > 0.0 else 1.5", "b if a == b or a != a else a",
    "3.0 if not a < b else a", "(a < b) + 1.0", "a * (b <= a)", "exp(a)", "log(b)", "maximum(a, b)",
    "minimum(a, b)", "sqrt(abs(a))", "sin(a) + cos(b)", "tanh(a)", "sign(a)", "floor(b)",
    "power(a, b)", "arctan2(a, b)", "logaddexp(a, b)", "ndtr(a)", "log1p(b)",
    "inf if a > b else nan", "1.0 / (a * a)", "a - (b - a)", "t + 1.0", "max(t - 1, 0) + 0.0",
]  # fmt: skip


@pytest.mark.parametrize("decorator", ["exact", "kernel"])
@pytest.mark.parametrize("expression", EXPRESSIONS)
def test_the_meaning_of_expressions(expression, decorator):
    """Over all pairs of odd numbers; loops that may reorder do so within one rounding or two."""
    text = (
        f'@{decorator}\ndef run(t, states_prev, states):\n    """Doc."""\n'
        "    n = states.shape[1]\n    first = states_prev[0]\n    second = states_prev[1]\n"
        "    for i in range(n):\n        a = first[i]\n        b = second[i]\n"
        f"        states[0, i] = {expression}\n"
    )
    pairs = np.array(list(itertools.product(ODD, ODD))).T.copy()
    values = {"t": 3, "states_prev": pairs, "states": np.zeros((1, pairs.shape[1]))}
    found = native_build.addresses("expression", text)
    called(found["run"], ["t", "states_prev", "states"], values)
    space = {n: _compiled(n) for n in HOMES}
    space |= {"exact": lambda f: f, "kernel": lambda f: f, "inf": np.inf, "nan": np.nan}
    exec(text, space)
    expected = np.zeros((1, pairs.shape[1]))
    with np.errstate(all="ignore"):
        space["run"](3, pairs, expected)
    rtol = 0.0 if decorator == "exact" else 4e-16
    np.testing.assert_allclose(values["states"], expected, rtol=rtol)


def _compiled(name):
    module = __import__(f"ssmppl.codegen.kernels.{HOMES[name]}", fromlist=[name])
    return getattr(module, name)


STATEMENTS = [
    "while a < 1.0: a = 2.0", "x = [a]", "states[0, 0], b = 1.0, 2.0", "b = a ** 2.0", "b = c.real",
    "for i in range(1, 3): a = 1.0", "b = unknown", "b = a < 1.0 < 2.0", "other(states)",
]  # fmt: skip


@pytest.mark.parametrize("statement", STATEMENTS)
def test_what_is_not_the_small_language(statement):
    """It is named, not translated into something else."""
    with pytest.raises(Untranslatable) as caught:
        translate(f"@exact\ndef run(theta, states):\n    a = theta[0]\n    {statement}\n")
    assert "run" in str(caught.value)


def walk(scale=1.0):
    model = ssm.Model("walk")

    @model.initial
    def initial():
        return {"x": ssm.Normal(0.0, sd=1.0)}

    @model.transition
    def transition(x):
        return {"x": ssm.Normal(scale * np.sin(x), sd=0.5)}

    @model.observation
    def observation(x):
        return {"y": ssm.StudentT(4.0, x, scale=0.3)}

    return model


def passes(model, seed=1):
    """(T, D, N) of a twisted filter through both ways of compiling it."""
    problem = pose(model, {"y": np.random.default_rng(2).normal(size=30)})
    twisted, e = problem.program.twisted, problem.experiments[0]
    u = twisted.guide(np.zeros(0), e.y, e.seen, e.u)
    out = []
    for module in (twisted.module, twisted.module.module):
        kept = np.empty((30, 1, 50)), np.empty((30, 50)), np.zeros((30, 50), dtype=np.int32)
        increments, ess = np.empty(30), np.empty(30)
        stream = new_state(np.random.SeedSequence(seed))
        module.filter_twisted(
            np.zeros(0), e.y, e.seen, u, 50, None, 1.0, stream, increments, ess, None, kept
        )  # fmt: skip
        out.append((*kept, increments, ess))
    assert isinstance(twisted.module, Loaded)
    assert not twisted.module.why
    return out


@pytest.mark.slow  # a minute of Numba for the second of the two
def test_a_filter_by_address_is_the_filter():
    """The same particles, weights, ancestors and evidence as with Numba throughout."""
    native, numba_made = passes(walk())
    for a, b in zip(native, numba_made, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


def test_matrices_are_left_to_numba():
    """The reason is kept, and the results are there."""
    model = ssm.Model("matrix")

    @model.prior
    def prior():
        return {"r": ssm.Uniform(-0.9, 0.9)}

    @model.initial
    def initial():
        return {"x": ssm.MvNormal(np.zeros(2), covariance=np.eye(2))}

    @model.transition
    def transition(x, r):
        return {"x": ssm.MvNormal(0.9 * x, covariance=np.array([[1.0, 0.5], [0.5, 1.0]]) + r**2)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x[0], sd=1.0)}

    drawn = ssm.simulate(model, {"r": 0.5}, steps=20, seed=1)
    program = pose(model, {"y": np.zeros(20)}).program
    assert np.all(np.isfinite(drawn["y"]))
    program.entry("simulate")
    assert "simulate" in program.loaded.why


def test_damaged_code_is_made_again(tmp_path, monkeypatch):
    """Half a file, or a changed one, is not run."""
    monkeypatch.setenv("SSMPPL_CACHE", str(tmp_path))
    text = "@exact\ndef run(theta, c):\n    c[0] = 2.0 * theta[0]\n"
    for damage in (lambda b: b[:100], lambda b: b[:40] + b"\0" + b[41:], lambda b: b""):
        native_build._built.clear()
        values = {"theta": np.array([3.0]), "c": np.zeros(1)}
        called(native_build.addresses("doubled", text)["run"], ["theta", "c"], values)
        assert values["c"][0] == 6.0
        (kept,) = cache.cache_folder().glob("doubled_*.o")
        kept.write_bytes(damage(kept.read_bytes()))
