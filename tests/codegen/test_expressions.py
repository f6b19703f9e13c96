"""Random expressions: the rendered text computes what the interpreter computes.

In plain Python the comparison is exact to the last bit, with the kernels' scalar functions in the
interpreter's table too, so that it is the text that is tested and not the accuracy of `exp`
(`tests/codegen/kernels` does that). A few are compiled and compared with the interpreter as it
stands.
"""

from types import FunctionType

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import ssmppl.language.distributions as D
from ssmppl.codegen.kernels.math import elementary, random, scalars, skellam, special
from ssmppl.codegen.kernels.math.flags import Kernel, exact, kernel
from ssmppl.codegen.text.module import Layout, Section, Target
from ssmppl.codegen.text.render import PHRASES, is_small_power
from ssmppl.codegen.text.sums import scalar_function
from ssmppl.expressions import evaluate as interpreter
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import (
    MATRIX_OPS,
    apply,
    item,
    matrix_op,
)
from ssmppl.expressions.operations import KERNELS, OPERATIONS
from ssmppl.language.model.model import Model
from ssmppl.language.tracing import trace
from tests.codegen.harness import plain, run_plainly


def small_model():
    model = Model("small", inputs=("u",))

    @model.prior
    def prior():
        return {"p": D.Normal(0, sd=1), "q": D.Normal(0, sd=1)}

    @model.initial
    def initial():
        return {"x": D.Normal(np.zeros(2), sd=1)}

    @model.transition
    def transition(x):
        return {"x": D.Normal(x, sd=1)}

    @model.observation
    def observation(x):
        return {"y": D.Normal(x, sd=1)}

    return trace(model)


TRACE = small_model()
SYMBOLS = [*TRACE.parameter_symbols, *TRACE.input_symbols, *TRACE.state_symbols]
NAMESPACE = {
    "np": np, "inf": np.inf, "nan": np.nan, "exact": exact, "kernel": kernel,
    "maximum": scalars.maximum, "abs": abs,
}  # fmt: skip
FILES = (elementary, scalars, skellam, special, random)
MODULES = {m.__name__.rpartition(".")[2]: m for m in FILES}
NAMESPACE |= {n: getattr(MODULES[f], n) for n, f in KERNELS.items() if f != "random"}


def test_every_operation_is_written():
    assert set(PHRASES) == set(OPERATIONS)
    for name, file in KERNELS.items():
        assert isinstance(getattr(MODULES[file], name), Kernel | FunctionType), name


def test_a_power_without_end_is_no_product():
    x = TRACE.state_symbols[0]
    assert not is_small_power(x**np.inf)
    assert is_small_power(x**3)


_EXP, _TRIG = ["exp", "log", "log1p", "expm1", "sqrt"], ["sin", "cos", "tanh", "arctan"]
ELEMENTARY = [*_EXP, *_TRIG, "abs", "sign", "floor"]
ARITHMETIC = ["add", "sub", "mul", "div", "maximum", "minimum", "logaddexp"]
CONDITIONS = ["lt", "le", "eq", "ne"]
numbers = st.one_of(
    st.sampled_from([0.0, 1.0, -1.0, 2.0, 0.5, 3.0]), st.floats(-4, 4, allow_nan=False)
)
leaves = st.one_of(st.sampled_from(SYMBOLS), numbers)


def conditions(children):
    compare = st.builds(apply, st.sampled_from(CONDITIONS), children, children)
    both = st.builds(apply, st.sampled_from(["and", "or"]), compare, compare)
    return st.one_of(compare, both, st.builds(lambda c: apply("not", c), compare))


def matrices(children):
    def entry(op, entries):
        node = matrix_op(op, entries, 2)
        return node if op in ("det", "logdet") else item(node, 1, 0)

    four = st.lists(children, min_size=4, max_size=4)
    return st.builds(entry, st.sampled_from(MATRIX_OPS), four)


def extend(children):
    return st.one_of(
        st.builds(apply, st.sampled_from(ELEMENTARY), children),
        st.builds(apply, st.sampled_from(ARITHMETIC), children, children),
        st.builds(apply, st.sampled_from(ARITHMETIC), children, children),
        st.builds(lambda a: apply("neg", a), children),
        st.builds(lambda a, k: apply("pow", a, k), children,
                  st.sampled_from([-4.0, -2.0, 2.0, 3.0, 4.0, 5.0, 1.5])),
        st.builds(apply, st.just("where"), conditions(children), children, children),
        st.builds(apply, st.just("mod"), children, st.sampled_from([2.0, 3.0, 0.5])),
        matrices(children),
    )  # fmt: skip


expressions = st.recursive(leaves, extend, max_leaves=25)


def as_table(monkeypatch):
    """The interpreter's table with the kernels' functions in it."""

    def vectorised(function):
        return lambda *args: np.float64(function(*map(float, args)))

    for op, operation in OPERATIONS.items():
        file, _, name = operation.kernel.rpartition(".")
        if file:
            monkeypatch.setitem(interpreter.MEANING, op, vectorised(NAMESPACE[name]))

    def power(a, b):
        if b == int(b) and 1 <= abs(b) <= 4:
            product = a
            for _ in range(int(abs(b)) - 1):
                product = product * a
            return product if b > 0 else 1.0 / product
        return np.float64(scalars.power(float(a), float(b)))

    def matrix(op, n, entries):
        result = NAMESPACE[op](tuple(map(float, entries)), n)
        return np.float64(result) if op in ("det", "logdet") else result

    monkeypatch.setitem(interpreter.MEANING, "pow", power)
    monkeypatch.setitem(interpreter.MEANING, "mod", lambda a, b: np.float64(a) % np.float64(b))
    monkeypatch.setattr(interpreter, "_matrix", matrix)


@pytest.fixture
def kernels_table(monkeypatch):
    as_table(monkeypatch)


def function_of(roots, decorated=False):
    """The function that writes the roots into `out`."""
    text = scalar_function(
        Layout(TRACE), "f", "theta, u_data, x, t, out", "Random.",
        [(f"out[{i}]", r) for i, r in enumerate(roots)],
        {s: f"x[{k}]" for k, s in enumerate(TRACE.state_symbols)},
    )  # fmt: skip
    if not decorated:
        return run_plainly(text, NAMESPACE)["f"], text
    space = dict(NAMESPACE)
    exec(compile(text, "<generated>", "exec"), space)
    return space["f"], text


values = st.lists(st.floats(-3, 3, allow_nan=False), min_size=5, max_size=5)


@settings(
    max_examples=150, deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)  # fmt: skip
@given(roots=st.lists(expressions, min_size=1, max_size=3), numbers=values)
def test_text_is_the_interpreter(kernels_table, roots, numbers):
    roots = [apply("add", r, 0.0) for r in roots]
    p, u, x = np.array(numbers[:2]), np.array([numbers[2:3]]), np.array(numbers[3:])
    f, text = function_of(roots)
    out = np.full(len(roots), -99.0)
    plain(f)(p, u, x, 0, out)
    expected = [float(v) for v in evaluate(roots, dict(zip(SYMBOLS, numbers, strict=True)))]
    np.testing.assert_array_equal(out, expected, err_msg=text)


@settings(
    max_examples=60, deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)  # fmt: skip
@given(
    roots=st.lists(expressions, min_size=2, max_size=2),
    guard=st.sampled_from([None, *TRACE.input_symbols]),
    numbers=st.lists(values, min_size=3, max_size=3),
)
def test_passes_over_particles_are_the_interpreter(kernels_table, roots, guard, numbers):
    """Binding times: what depends on theta or on the step is computed outside the loop."""
    roots = [apply("add", r, 0.0) for r in roots]
    particles = np.array([row[3:] for row in numbers]).T.copy()
    theta, u = np.array(numbers[0][:2]), np.array([numbers[0][2:3]])
    section = Section(Layout(TRACE), "test")
    targets = [Target("log_w[i]", roots[0]), Target("log_w[i]", roots[1], guard)]
    section.particle_pass("weigh", "Random.", "theta, c, s, states, log_w", targets,
                          accumulate="log_w")  # fmt: skip
    space = run_plainly(section.finish(), NAMESPACE)
    c, s, log_w = np.full(60, np.nan), np.full(60, np.nan), np.zeros(3)
    plain(space["prepare_test"])(theta, c)
    plain(space["step_test"])(theta, c, np.zeros((1, 2)), np.ones((1, 2)), u, 0, s)
    plain(space["weigh_test"])(theta, c, s, particles, log_w)
    for i in range(3):
        known = dict(zip(SYMBOLS, [*theta, u[0, 0], *particles[:, i]], strict=True))
        first, second = (float(v) for v in evaluate(roots, known))
        expected = first + second if guard is None or u[0, 0] != 0.0 else first
        if guard is None:  # targets without a guard are one sum, simplified as one
            expected = float(evaluate(apply("add", *roots), known))
        np.testing.assert_array_equal(log_w[i], expected, err_msg=section.finish())


@pytest.mark.parametrize("seed", range(6))
def test_compiled_is_the_interpreter(seed):
    """Smooth expressions, drawn once for good, compiled, against NumPy and SciPy."""
    rng = np.random.default_rng(seed)
    smooth = ["exp", "expm1", "erf", "ndtr", "log_ndtr", "sinh", "cosh", "arcsinh", *_TRIG]
    pool = list(SYMBOLS)
    for _ in range(25):
        a, b = (pool[i] for i in rng.integers(0, len(pool), 2))
        op = rng.choice([*smooth, "add", "sub", "mul", "where", "maximum", "logaddexp"])
        if op in smooth:
            a = apply("tanh", a)
            pool.append(apply(str(op), a))
        elif op == "where":
            pool.append(apply("where", apply("lt", SYMBOLS[0], SYMBOLS[3]), a, b))
        else:
            pool.append(apply(str(op), a, b))
    roots = pool[-4:]
    f, _ = function_of(roots, decorated=True)
    numbers = rng.normal(size=5)
    out = np.empty(4)
    f(numbers[:2], numbers[None, 2:3], numbers[3:], 0, out)
    expected = evaluate(roots, dict(zip(SYMBOLS, numbers, strict=True)))
    np.testing.assert_allclose(out, expected, rtol=1e-12, atol=1e-14)
