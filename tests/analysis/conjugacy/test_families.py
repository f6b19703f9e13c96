"""Each conjugate family by itself against its functions, spelled out: density, draws, mode,
normalising constant. A new family has a row, or more, in `CASES`."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy import integrate, stats

from ssmppl.analysis.conjugacy.families import SCALED, SINGLE, Beta, Dirichlet, Gamma, Normal
from ssmppl.analysis.conjugacy.families import NormalGamma as NG
from ssmppl.analysis.conjugacy.family import sum_of
from ssmppl.analysis.conjugacy.matrix_families import Wishart, symmetric
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import constant, topological
from ssmppl.language.distributions import Draws
from tests.statistics.checks import LEVEL, seed_of

WHOLE, HALF, UNIT = (-np.inf, np.inf), (0.0, np.inf), (0.0, 1.0)
ONE, PAIR = Normal((1,), ((0,),)), Normal((3, 4), ((0, 1), (1, 2)))
SMALL = [-1.0, -0.6, -0.75, 1.0, -2.0]


def power(k):
    return lambda v: [np.log(v[0]), v[0] ** k]


def square(v):
    return [v[0] ** 2, v[0]]


def pair(v):
    return [v[0] ** 2, v[0] * v[1], v[1] ** 2, v[0], v[1]]


def scaled(normal, k):
    """Those of a Normal block times v**k, log v and v**k."""
    return lambda v: [*(v[-1] ** k * f for f in normal(v)), np.log(v[-1]), v[-1] ** k]


def shares(v):
    return [*np.log(v)]


def matrix(v, inverse=False):
    m = symmetric(v, 2)
    if np.linalg.eigvalsh(m)[0] <= 0:
        return [np.nan] * (5 if inverse else 4)
    if inverse:
        return [np.log(np.linalg.det(m)), *np.linalg.inv(m).ravel()]
    return [np.log(np.linalg.det(m)), m[0, 0], m[1, 0], m[1, 1]]


@dataclass(frozen=True)
class Case:
    """A family with its functions s_i(v), statistics C_i and limits."""

    family: Any
    functions: Any
    c: list[float]
    limits: list[tuple[float, float]]

    @property
    def statistics(self):
        return [*self.c, 0.0]

    def log_density(self, v, c=None):
        with np.errstate(all="ignore"):
            return float(np.dot(self.c if c is None else c, self.functions(v)))


BETA = lambda v: [np.log(v[0]), np.log1p(-v[0])]  # noqa: E731
CASES = {
    "Gamma": Case(Gamma(1.0, 0, 1), power(1), [4.0, -2.0], [HALF]),
    "Gamma, bound above": Case(Gamma(1.0, 0, 1), power(1), [4.0, -2.0], [(0.0, 1.5)]),
    "Gamma, falling": Case(Gamma(1.0, -1, 1), power(1), [0.0, -2.0], [(0.5, 3.0)]),
    "inverse Gamma": Case(Gamma(-1.0, 0, 1), power(-1), [-6.0, -2.5], [HALF]),
    "inverse Gamma, bound below": Case(
        Gamma(-1.0, 0, 1), power(-1), [-6.0, -2.5], [(1.0, np.inf)]
    ),
    "inverse Gamma of the square": Case(Gamma(-2.0, 0, 1), power(-2), [-6.0, -2.5], [(0.0, 10.0)]),
    "Normal": Case(ONE, square, [-0.7, 1.3], [WHOLE]),
    "Normal, bound": Case(ONE, square, [-0.7, 1.3], [(-1.0, 0.5)]),
    "joint Normal": Case(PAIR, pair, SMALL, [WHOLE, WHOLE]),
    "joint Normal, one bound": Case(PAIR, pair, SMALL, [(-1.0, 0.4), WHOLE]),
    "joint Normal, corner": Case(PAIR, pair, SMALL, [(-1.0, 0.4), (-1.0, 1.0)]),
    "Normal-Gamma of one": Case(
        NG(1.0, 2, 3, ONE), scaled(square, 1), [-0.8, 0.7, 3.1, -2.0], [WHOLE, HALF]
    ),
    "Normal-Gamma": Case(
        NG(1.0, 5, 6, PAIR), scaled(pair, 1), [*SMALL, 7.0, -4.0], [WHOLE, WHOLE, HALF]
    ),
    "Normal-Gamma, bounds": Case(
        NG(1.0, 5, 6, PAIR), scaled(pair, 1), [*SMALL, 7.0, -4.0],
        [(-1.0, 0.4), WHOLE, (0.0, 1.1)],
    ),
    "Normal-inverse-Gamma": Case(
        NG(-1.0, 5, 6, PAIR), scaled(pair, -1), [*SMALL, -7.0, -4.0], [WHOLE, WHOLE, HALF]
    ),
    "Beta": Case(Beta(0, 1), BETA, [3.0, 5.0], [UNIT]),
    "Beta, bounds": Case(Beta(0, 1), BETA, [3.0, 5.0], [(0.5, 0.9)]),
    "Dirichlet": Case(Dirichlet((0, 1, 2)), shares, [3.0, 5.0, 0.5], [WHOLE] * 3),
    "Wishart": Case(
        Wishart(2, 0, (1, -1, 2, 3), False), matrix, [2.5, -1.5, -0.7, -1.0], [WHOLE] * 3
    ),
    "inverse Wishart": Case(
        Wishart(2, 0, (1, 2, 3, 4), True), lambda v: matrix(v, inverse=True),
        [-2.5, -1.5, -0.35, -0.35, -1.0], [WHOLE] * 3,
    ),
}  # fmt: skip
BY_ELIMINATION = [n for n, c in CASES.items() if c.family.written_out and "bound" not in n]


def test_all_families_have_a_case():
    """Matrix Normal-Wishart laws, of more functions than can be spelled out here, are held against
    SciPy's in `test_draws.py`."""
    found = {type(case.family) for case in CASES.values()}
    assert {*SINGLE, *SCALED} - found == {SCALED[-1]}


@pytest.mark.parametrize("name", CASES)
def test_log_density_is_the_sum_of_the_functions(name):
    case, rng = CASES[name], np.random.default_rng(seed_of("density", name))
    first, *others = (np.array(case.family.draw(case.statistics, rng)) for _ in range(6))
    for v in others:
        found = case.family.log_q(case.statistics, v) - case.family.log_q(case.statistics, first)
        assert found == pytest.approx(case.log_density(v) - case.log_density(first), abs=1e-9)


@pytest.mark.parametrize("name", [n for n, c in CASES.items() if len(c.limits) == 1])
def test_draws_within_limits_have_the_density(name):
    """By quadrature of the functions between the limits."""
    case, rng = CASES[name], np.random.default_rng(seed_of("within", name))
    drawn = [case.family.draw_within(case.statistics, case.limits, rng)[0] for _ in range(3000)]
    top = case.log_density(case.family.mode(case.statistics, case.limits, np.ones(1)))
    low, high = case.limits[0]
    grid = np.linspace(max(low, min(drawn) - 1.0), min(high, max(drawn) + 1.0), 20_001)[1:-1]
    mass = np.cumsum(np.exp([case.log_density([x]) - top for x in grid]))
    cdf = np.interp(drawn, grid, mass / mass[-1])
    assert stats.kstest(cdf, "uniform").pvalue > LEVEL


# -- the mode
@pytest.mark.parametrize("name", CASES)
def test_mode(name):
    """No other point within the limits has a larger sum: near by, far, and on a line to each."""
    case, rng = CASES[name], np.random.default_rng(seed_of("mode", name))
    simplex, n = case.family.kind == "simplex", len(case.limits)
    start = np.full(n, 1.0 / n) if simplex else np.full(n, 0.6)
    found = case.family.mode(case.statistics, case.limits, start)
    best = case.log_density(found)
    low, high = np.array(case.limits).T
    assert np.all((found > low) & (found < high))
    compared = 0
    for size in (1e-4, 1e-2, 1.0, 10.0):
        for _ in range(400):
            step = size * rng.standard_normal(n)
            other = found * np.exp(step) if simplex else found + step
            other = other / other.sum() if simplex else np.clip(other, low, high)
            value = case.log_density(other)
            if np.isfinite(value):
                compared += 1
                assert value <= best + 1e-7 * (1 + abs(best)), (found, other)
    assert compared > 400


def test_a_sum_that_rises_has_its_mode_at_the_bound():
    found = Gamma(1.0, 0, -1).mode([4.0, 0.0, 0.0], [(0.0, 3.0)], np.ones(1))
    assert 3.0 - 1e-8 < found[0] < 3.0


@pytest.mark.parametrize(
    ("family", "c"),
    [
        (Gamma(1.0, 0, 1), [4.0, 2.0]),  # rises for ever
        (Gamma(-1.0, 0, 1), [6.0, -2.0]),
        (ONE, [0.7, 1.3]),
        (ONE, [0.0, 1.3]),
        (Beta(0, 1), [-1.0, 2.0]),
        (Wishart(2, 0, (1, -1, 2, 3), False), [2.5, -1.5, -4.0, -1.0]),
    ],
)
def test_no_mode_where_the_sum_has_no_maximum(family, c):
    n = len(family.support)
    assert family.mode([*c, 0.0], [WHOLE] * n, np.ones(n)) is None


def test_flat_directions_keep_the_present_value():
    """x = a + b on one regressor only: a - b is not told by the data."""
    c = [-0.5, -1.0, -0.5, 2.0, 2.0]
    found = PAIR.mode([*c, 0.0], [WHOLE, WHOLE], np.array([3.0, 0.0]))
    np.testing.assert_allclose(found, [2.5, -0.5])


# -- in expressions
def log_normaliser(case, c):
    summands = case.family.log_normaliser([*map(constant, c), constant(0.0)])
    return float(evaluate(sum_of(summands), {}))


@pytest.mark.parametrize("name", [n for n in BY_ELIMINATION if len(CASES[n].limits) < 3])
def test_ratios_of_normalising_constants_are_integrals(name):
    """Z(C + c) / Z(C), by quadrature over the block."""
    case = CASES[name]
    more = [v * f for v, f in zip(case.c, (1.3, 1.2, 1.4, 1.1, 1.25), strict=False)]
    ranges = [(-9, 9)] * 2 if case.family is PAIR else case.family.support

    def log_integral(values):
        return np.log(integrate.nquad(lambda *v: np.exp(case.log_density(v, values)), ranges)[0])

    expected = log_integral(more) - log_integral(case.c)
    found = log_normaliser(case, more) - log_normaliser(case, case.c)
    assert found == pytest.approx(expected, abs=1e-6)


def test_constant_of_a_dirichlet():
    case, p = CASES["Dirichlet"], [0.2, 0.5, 0.3]
    known = stats.dirichlet(np.array(case.c) + 1).logpdf(p)
    assert case.log_density(p) - log_normaliser(case, case.c) == pytest.approx(known)


@pytest.mark.parametrize("name", BY_ELIMINATION)
def test_written_draws_have_the_law_that_numbers_are_drawn_from(name):
    """Of each component, by a Kolmogorov-Smirnov test of two samples."""
    case = CASES[name]
    n, rng = 20_000, np.random.default_rng(seed_of("written", name))
    drawn = case.family.written_draw([*map(constant, case.c), constant(0.0)], Draws("test"))
    values = {}
    for e in topological(drawn):
        if e.op != "random":
            continue
        if e.data[0] == "gamma_by":
            values[e] = rng.standard_gamma(float(evaluate(e.args[0], {})), n)
        else:
            values[e] = rng.standard_normal(n) if e.data[0] == "normal" else rng.uniform(size=n)
    other = np.array([case.family.draw(case.statistics, rng) for _ in range(n)]).T
    for a, b in zip(np.array(evaluate(drawn, values)), other, strict=True):
        assert stats.ks_2samp(a, b).pvalue > LEVEL
