"""Native code does what the text says: every function of the corpus, and the small language."""

import itertools
import math

import llvmlite.binding as llvm
import numpy as np
import pytest
from numba.core.errors import TypingError

import ssmppl as ssm
from ssmppl.codegen.kernels.math.calls import address_of
from ssmppl.codegen.kernels.math.flags import exact
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.codegen.modules.filter_variants import numbered_filter, scored_filter
from ssmppl.codegen.native import build as native_build
from ssmppl.codegen.native import loading
from ssmppl.codegen.native.build import addresses
from ssmppl.codegen.native.library import function_ir
from ssmppl.codegen.native.loading import Loaded
from ssmppl.codegen.native.translate import Untranslatable, translate
from ssmppl.codegen.store import folder
from ssmppl.expressions.operations import KERNELS, MATRIX_OPS
from ssmppl.inference.run.problem import pose
from ssmppl.language.tracing import trace
from tests.codegen.harness import Numbers
from tests.codegen.native_calls import both_ways, called, sections
from tests.models.statements import MODELS, build

pytestmark = pytest.mark.skipif(
    native_build.llvm.llvm_version_info[0] < native_build.OLDEST,
    reason="this LLVM has typed pointers, and Numba compiles everything",
)

CASES = [(name, name != "varves") for name in MODELS]  # with guards for gaps, and once without


@pytest.mark.parametrize(("name", "gaps"), CASES, ids=[name for name, _ in CASES])
def test_every_function_of_the_corpus(name, gaps):
    """Native and interpreted functions leave the same numbers in all their arguments."""
    traced = trace(build(name))
    rng = np.random.default_rng(4)
    numbers = Numbers(traced, rng, gaps)
    plain, parts = sections(traced, gaps)
    done = 0
    for part, section, text in parts:
        for what, native, interpreted, _ in both_ways(plain, part, section, text, numbers, rng):
            np.testing.assert_allclose(native, interpreted, rtol=1e-12, atol=1e-13, err_msg=what)
            done += 1
    assert done


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
    space = {n: _compiled(n) for n in KERNELS}
    space |= {"exact": lambda f: f, "kernel": lambda f: f, "inf": np.inf, "nan": np.nan}
    exec(text, space)
    expected = np.zeros((1, pairs.shape[1]))
    with np.errstate(all="ignore"):
        space["run"](3, pairs, expected)
    rtol = 0.0 if decorator == "exact" else 4e-16
    np.testing.assert_allclose(values["states"], expected, rtol=rtol)


def _compiled(name):
    module = __import__(f"ssmppl.codegen.kernels.math.{KERNELS[name]}", fromlist=[name])
    return getattr(module, name)


STATEMENTS = [
    "for i in range(3): a = states",
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


@pytest.mark.slow  # half a minute of Numba for the second of the two
def test_conditional_smc_by_address_is_the_same():
    """Every proposal's sweep, from the same numbers, and the path that it begins with."""
    problem = pose(walk(0.9), {"y": np.random.default_rng(3).normal(size=40)})
    program, e, theta = problem.program, problem.experiments[0], np.zeros(0)
    assert not program.loaded.why
    for proposal in ("bootstrap", "guided", "auxiliary"):
        found = []
        for module in (program.loaded, program.module):
            stream = new_state(np.random.SeedSequence(5))
            path, new = np.empty((e.steps, 1)), np.empty((e.steps, 1))
            increments, figures = np.empty(e.steps), np.empty(2)
            begin = getattr(module, f"filtered_path_{proposal}")
            begin(theta, e.y, e.seen, e.u, 30, stream, path, increments)
            sweep = getattr(module, f"conditional_smc_{proposal}")
            for _ in range(20):
                sweep(theta, e.y, e.seen, e.u, 30, stream, path, new, figures)
                path, new = new, path
            found.append((path, increments, figures))
        for a, b in zip(*found, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10)


def moments(model):
    """A guided filter's moments and predictions through both ways of compiling them."""
    problem = pose(model, {"y": np.random.default_rng(7).normal(size=25)})
    program, e, out = problem.program, problem.experiments[0], []
    for module in (program.loaded, program.module):
        levels, predicted = np.array([0.1, 0.5]), (np.empty((25, 4, 1)), np.empty((25, 2, 1)))
        written = np.empty((25, 1)), np.empty((25, 1, 1)), np.empty((25, 2, 1))
        increments, ess = np.empty(25), np.empty(25)
        stream, apart = (new_state(np.random.SeedSequence(k)) for k in (2, 3))
        module.filter_guided(
            np.zeros(0), e.y, e.seen, e.u, 40, 0, 0.5, stream, increments, ess,
            (levels, *written, (predicted[0], levels, predicted[1], apart)), None,
        )  # fmt: skip
        out.append((*written, *predicted, increments, ess))
    assert not program.loaded.why
    return out


@pytest.mark.slow  # a minute of Numba for the second of the two
def test_predictions_by_address_are_the_same():
    for a, b in zip(*moments(walk(0.8)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


def test_what_a_new_model_needs_no_numba_for():
    """Filters with predictions, on given numbers and with a score."""
    model = ssm.Model("rate")

    @model.prior
    def prior():
        return {"r": ssm.Uniform(-0.9, 0.9)}

    @model.initial
    def initial():
        return {"x": ssm.Normal(0.0, sd=1.0)}

    @model.transition
    def transition(x, r):
        return {"x": ssm.Normal(r * np.sin(x), sd=0.5)}

    @model.observation
    def observation(x):
        return {"y": ssm.StudentT(4.0, x, scale=0.3)}

    program = pose(model, {"y": np.zeros(20)}).program
    program.entry("filter_guided")
    assert not program.loaded.why
    proposal = program.proposals["guided"]
    wanted = tuple(program.trace.parameter_symbols)
    numbered = numbered_filter(program, proposal)
    scored = [scored_filter(program, proposal, wanted, second) for second in (False, True)]
    for made, name in ((numbered, "correlated_path"), *((s, "path_score") for s in scored)):
        assert getattr(made.module, name) is not getattr(made.module.module, name)
        assert not made.module.why


def test_predictions_are_compiled_when_they_are_asked_for(monkeypatch):
    """A likelihood does not wait for them; where they have no address, Numba makes them."""
    made, refused = [], False

    def recorded(name, text):
        made.append(name.rpartition("_")[2])
        if refused and made[-1] == "predict":
            raise Untranslatable("an invention", fix="")
        return addresses(name, text)

    monkeypatch.setattr(loading, "addresses", recorded)
    y = {"y": np.random.default_rng(4).normal(size=6)}
    model = walk(0.35)
    ssm.log_likelihood(model, y, {}, particles=20, proposal="bootstrap", seed=1)
    assert made == ["bootstrap"]
    found = ssm.particle_filter(model, y, {}, particles=20, proposal="bootstrap", seed=1)
    assert made == ["bootstrap", "predict"]
    assert np.isfinite(found["y_predicted_quantile"]).all()
    refused, instead = True, []
    problem = pose(walk(0.35), y)
    loaded, e = problem.program.loaded, problem.experiments[0]
    monkeypatch.setattr(loaded.module, "filter_bootstrap", lambda *given: instead.append(given))
    for moments in (None, ()):
        loaded.filter_bootstrap(
            np.zeros(0), e.y, e.seen, e.u, 20, 0, 1.0, new_state(np.random.SeedSequence(1)),
            np.empty(6), np.empty(6), moments, None,
        )  # fmt: skip
        assert len(instead) == (moments is not None)


def test_arrays_with_gaps_have_no_address():
    """A function called by address reads elements that stand one after the other."""

    @exact
    def place(array):
        return address_of(array)

    array = np.zeros((4, 6))
    assert place(array) == array.ctypes.data
    assert place(array[2]) == array.ctypes.data + 2 * array.strides[0]
    with pytest.raises(TypingError, match="gaps between its elements"):
        place(array[:, ::2])


def matrices(n):
    """Some of each kind: of covariances, others, with rows to swap, singular, not numbers."""
    rng = np.random.default_rng(n)
    for _ in range(4):
        a = rng.normal(size=(n, n))
        yield from (a, a @ a.T + 0.1 * np.eye(n))
    for broken in (np.nan, np.inf, 0.0):
        a = rng.normal(size=(n, n))
        a[rng.integers(n)] = broken
        yield a
    yield from (np.zeros((n, n)), np.ones((n, n)), -np.eye(n), np.eye(n)[::-1])


@pytest.mark.parametrize("n", [1, 2, 3, 5])
@pytest.mark.parametrize("operation", MATRIX_OPS)
def test_operations_on_matrices(operation, n):
    """The numbers of the kernel, also where there are none."""
    entries = ", ".join(f"theta[{k}]" for k in range(n * n))
    lines = [f"    a = {operation}(({entries},), {n})"]
    if operation in ("cholesky", "inverse"):
        lines += [f"    c[{n * i + j}] = a[{i}, {j}]" for i in range(n) for j in range(n)]
    else:
        lines.append("    c[0] = a")
    text = "@exact\ndef run(theta, c):\n" + "\n".join(lines) + "\n"
    address = native_build.addresses(operation, text)["run"]
    for a in matrices(n):
        values = {"theta": a.ravel(), "c": np.zeros(n * n)}
        called(address, ["theta", "c"], values)
        expected = _compiled(operation)(tuple(a.ravel()), n)
        if operation == "cholesky":
            lower = np.tril_indices(n)
            found, expected = values["c"].reshape(n, n)[lower], expected[lower]
        else:
            found = values["c"][: np.size(expected)].reshape(np.shape(expected))
        np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-14, err_msg=str(a))


TABLE = np.linspace(0.0, 1.0, 5)


@ssm.primitive
def bent(v, strength):
    return TABLE[2] * v if v > 1.0 else strength * math.tanh(v) + v**2.5


@ssm.primitive
def raising(v):
    if v > 10.0:
        raise ValueError("too large")
    return v


@ssm.primitive
def with_room(v):
    room = np.zeros(int(abs(v)) + 3)
    room[1] = v
    return room.sum()


def test_primitives_are_taken_in():
    """With the constants that they read, and what they call of the mathematical library."""
    text = f"@exact\ndef run(theta, c):\n    c[0] = {bent.name}(theta[0], theta[1])\n"
    address = addresses("primitive", text)["run"]
    for v in (-0.5, 0.7, 3.0):
        values = {"theta": np.array([v, 2.0]), "c": np.zeros(1)}
        called(address, ["theta", "c"], values)
        np.testing.assert_allclose(values["c"][0], bent.compiled(v, 2.0), rtol=1e-15)


@ssm.primitive
def moved(q, v, k):
    for _ in range(10):
        q, v = q + 0.005 * v, v - 0.005 * k * math.sin(q)
    return q


DERIVATIVES = [(1, 0, 0), (0, 0, 1), (2, 0, 0), (1, 0, 1)]


def test_derivatives_of_primitives_are_taken_in():
    """Though they go on calling the function, which LLVM sees to raise nothing."""
    found = [moved.difference(index) for index in DERIVATIVES]
    calls = [f"    c[{k}] = {d.name}(theta[0], theta[1], theta[2])\n" for k, d in enumerate(found)]
    text = "@exact\ndef run(theta, c):\n" + "".join(calls)
    values = {"theta": np.array([0.4, -1.3, 9.0]), "c": np.zeros(len(found))}
    called(addresses("derivatives", text)["run"], ["theta", "c"], values)
    expected = [d.compiled(*values["theta"]) for d in found]
    np.testing.assert_allclose(values["c"], expected, rtol=1e-12)


def test_functions_taken_in_have_no_names_but_their_own():
    """Numba counts its names up anew in each process, and what two processes have kept is linked
    together: then the names would clash."""
    for d in (moved, moved.difference((1, 0, 0))):
        module = llvm.parse_assembly(function_ir(d.name, 3, False))
        seen = [
            f.name for f in module.functions
            if not f.is_declaration and f.linkage != llvm.Linkage.internal
        ]  # fmt: skip
        assert seen == [f"lib_{d.name}"]


@pytest.mark.parametrize(
    "primitive", [raising, with_room, raising.difference((1,))],
    ids=["raises", "allocates", "derivative of what raises"],
)  # fmt: skip
def test_primitives_that_need_python_are_left_to_numba(primitive):
    with pytest.raises(Untranslatable, match=primitive.name):
        addresses("primitive", f"@exact\ndef run(c):\n    c[0] = {primitive.name}(c[0])\n")


def test_large_matrices_are_left_to_numba():
    """The reason is kept, and the results are there."""
    model, n = ssm.Model("matrix"), 7

    @model.prior
    def prior():
        return {"r": ssm.Uniform(-0.9, 0.9)}

    @model.initial
    def initial():
        return {"x": ssm.Normal(np.zeros(n), sd=1.0)}

    @model.transition
    def transition(x, r):
        return {"x": ssm.Normal(0.9 * np.linalg.inv(np.eye(n) + r**2) @ x, sd=1.0)}

    @model.observation
    def observation(x):
        return {"y": ssm.Normal(x[0], sd=1.0)}

    problem = pose(model, {"y": np.zeros(3)})
    (e,), total = problem.experiments, np.empty(1)
    run = problem.program.entry("log_joint")
    assert "inverse" in problem.program.loaded.why["log_joint"]
    run(np.array([0.5]), e.y, e.seen, e.u, np.zeros((3, n)), total)
    assert total[0] == pytest.approx(-0.5 * np.log(2 * np.pi) * (3 * n + 3), rel=1e-12)


def test_damaged_code_is_made_again(tmp_path, monkeypatch):
    """Half a file, or a changed one, is not run."""
    monkeypatch.setenv("SSMPPL_CACHE", str(tmp_path))
    text = "@exact\ndef run(theta, c):\n    c[0] = 2.0 * theta[0]\n"
    for damage in (lambda b: b[:100], lambda b: b[:40] + b"\0" + b[41:], lambda b: b""):
        native_build._built.clear()
        values = {"theta": np.array([3.0]), "c": np.zeros(1)}
        called(native_build.addresses("doubled", text)["run"], ["theta", "c"], values)
        assert values["c"][0] == 6.0
        (kept,) = folder.cache_folder().glob("doubled_*.o")
        kept.write_bytes(damage(kept.read_bytes()))


SMALL_STEPS = '''
@kernel
def run(states, theta, c):
    """A matrix before small steps that is read in them and after them; steps in turn, as many as
    there are numbers of a row, and none."""
    n = states.shape[1]
    row = states[0]
    for i in range(n):
        m = inverse((2.0, theta[0], 0.3, 3.0 + row[i] * row[i]), 2)
        large = row[i] > 0.5
        z = 0.0 + row[i]
        y = 0.0 + 1.0
        for k in range(whole(theta[1])):
            new = z * m[0, 1] + (0.1 if large else -0.2)
            z = new + 0.01 * y
            y = y - z
        after = z + m[1, 1]
        x = 0.0 + after
        for k in range(whole(theta[2])):
            x = 2.0 * x
        states[1, i] = x + (1.0 if large else y)
    for k in range(3):
        c[k] = theta[k]
'''


@pytest.mark.parametrize("particles", [1, 63, 64, 65, 200])
def test_small_steps_of_many_particles(particles):
    theta = np.array([0.4, 5.0, 2.0])
    states = np.zeros((2, particles))
    states[0] = np.random.default_rng(2).normal(size=particles)
    values = {"states": states, "theta": theta, "c": np.zeros(3)}
    called(addresses("small_steps", SMALL_STEPS)["run"], list(values), values)
    for x0, found in zip(states[0], states[1], strict=True):
        m = np.linalg.inv([[2.0, 0.4], [0.3, 3.0 + x0 * x0]])
        z, y = x0, 1.0
        for _ in range(5):
            z = z * m[0, 1] + (0.1 if x0 > 0.5 else -0.2) + 0.01 * y
            y -= z
        expected = 4.0 * (z + m[1, 1]) + (1.0 if x0 > 0.5 else y)
        assert found == pytest.approx(expected, rel=1e-13)


def test_small_steps_may_be_none():
    values = {"states": np.full((2, 70), 0.7), "theta": np.array([0.4, np.nan, -3.0]),
              "c": np.zeros(3)}  # fmt: skip
    called(addresses("small_steps", SMALL_STEPS)["run"], list(values), values)
    m = np.linalg.inv([[2.0, 0.4], [0.3, 3.49]])
    np.testing.assert_allclose(values["states"][1], 0.7 + m[1, 1] + 1.0, rtol=1e-14)
