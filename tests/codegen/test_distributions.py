"""Compiled samplers and log densities of every distribution against SciPy.

One generated module for each distribution and spelling of its parameters: the state's law is the
distribution with symbols for parameters, whose values come in theta.
"""

import contextlib
import functools
import math
import zlib
from functools import partial

import numpy as np
import pytest
import scipy.stats as st

import ssmppl.language.distributions as D
from ssmppl.codegen.kernels.math.random import fill_normal, fill_uniform, new_state
from ssmppl.codegen.modules.program import compile_trace
from ssmppl.codegen.native.build import addresses
from ssmppl.codegen.native.translate import Untranslatable
from ssmppl.codegen.store import folder
from ssmppl.codegen.text.kernel_functions import DRAW_INITIAL, WEIGH_INITIAL
from ssmppl.codegen.text.module import Layout, ModuleText, Section, Target
from ssmppl.errors import Location
from ssmppl.expressions.arrays import array
from ssmppl.expressions.evaluate import evaluate
from ssmppl.language.distributions.draws import Draws
from ssmppl.language.model.trace import Site, Trace, symbols
from ssmppl.language.tracing import trace
from tests.codegen.native_calls import called
from tests.language.distributions.distribution_table import CASES, JOINT_CASES, TRUNCATED_CASES
from tests.language.distributions.test_truncated import COUNTS, check_counts
from tests.models.statements import declare

N = 20_000
LEVEL = 1e-6 / (len(CASES) + 6 * len(JOINT_CASES) + len(TRUNCATED_CASES))  # Bonferroni
NOWHERE = Location("<test>", 1)


def by_address(address, arguments, *values):
    """Call a native function, given its arguments' names in a row."""
    names = arguments.split(", ")
    called(address, names, dict(zip(names, values, strict=True)))


class Compiled:
    """Sampler and log density of one distribution, as passes over particles."""

    def __init__(self, distribution, parameters):
        value = symbols("state", "x", distribution.shape, distribution.symmetric)
        site = Site("x", "state", distribution, value, NOWHERE)
        each = [
            Site(s.data[1], "parameter", D.Normal(0, sd=1), array([s]), NOWHERE) for s in parameters
        ]
        traced = Trace(
            "law", {str(i): s for i, s in enumerate(each)}, {"x": site}, {"x": site}, {}, {}, {}, {}
        )
        section = Section(Layout(traced), "law")
        place = {s: k for k, s in enumerate(traced.state_symbols)}
        sample = dict(
            zip(value.ravel(), array(distribution.sample(Draws("x"))).ravel(), strict=True)
        )
        draws = [Target(f"states[{k}, i]", sample[s]) for s, k in place.items()]
        section.particle_pass("draw", "Draw.", DRAW_INITIAL, draws)
        density = Target("log_w[i]", distribution.log_density(value))
        section.particle_pass("weigh", "Log density.", WEIGH_INITIAL, [density])
        text = ModuleText(section.layout)
        text.add("law", section)
        module = folder.load("law", text.finish(["A law."]))
        self.functions = {role: getattr(module, section.name(role)) for role in section.roles}
        with contextlib.suppress(Untranslatable):  # matrices are left to Numba
            found = addresses("law", text.texts[id(section)])
            self.functions = {
                role: partial(by_address, found[section.name(role)], arguments)
                for role, arguments in section.roles.items()
            }
        self.section, self.states = section, len(place)
        self.index = [place[s] for s in value.ravel()]  # flat value -> row of states
        self.noise = section.normals, section.uniforms

    def constants(self, theta):
        c = np.empty(len(self.section.c))
        self.functions["prepare"](theta, c)
        return c

    def sample(self, theta, seed, n=N):
        """(size of the value, n) draws."""
        rng = new_state(np.random.SeedSequence(seed))
        normals, uniforms = (np.empty(k * n) for k in self.noise)
        fill_normal(rng, normals)
        fill_uniform(rng, uniforms)
        out = np.empty((self.states, n))
        c = self.constants(theta)
        self.functions["draw"](theta, c, np.empty(0), out, normals, uniforms, rng)
        return out[self.index]

    def log_density(self, theta, values):
        """values: (size of the value, n)."""
        states = np.empty((self.states, values.shape[1]))
        states[self.index] = values
        log_w = np.empty(values.shape[1])
        self.functions["weigh"](theta, self.constants(theta), np.empty(0), states, log_w)
        return log_w


@functools.cache
def _compiled(cls, names, shapes, bounds):
    case = next(
        c for c in [*CASES, *JOINT_CASES]
        if (c.cls, tuple(c.parameters), tuple(np.shape(v) for v in c.parameters.values()))
        == (cls, names, shapes)
    )  # fmt: skip
    distribution, values = case.with_symbols()
    if bounds is not None:
        distribution = D.Truncated(distribution, **dict(bounds))
    return Compiled(distribution, list(values)), list(values)


def compiled(case, bounds=None):
    """(Compiled, theta) of a case; modules are shared by cases that differ in numbers only."""
    shapes = tuple(np.shape(v) for v in case.parameters.values())
    bounds = None if bounds is None else tuple(bounds.items())
    made, order = _compiled(case.cls, tuple(case.parameters), shapes, bounds)
    _, values = case.with_symbols()
    return made, np.array([values[s] for s in order])


def seed_of(case):
    return zlib.crc32(case.id.encode())


def check_sample(x, law, discrete):
    """One sample of a scalar law: Kolmogorov-Smirnov, or chi-square over the common values."""
    if not discrete:
        assert st.kstest(x, law.cdf).pvalue > LEVEL
        return
    assert np.all(x == np.floor(x))
    low, high = np.min(x), np.max(x)
    k = np.arange(low, min(high, low + 5000) + 1)
    expected = law.pmf(k) * len(x)
    big = expected >= 8
    observed = np.array([np.sum(x == v) for v in k[big]])
    o = np.append(observed, len(x) - observed.sum())
    e = np.append(expected[big], len(x) - expected[big].sum())
    if e[-1] < 5:
        assert o[-1] < 60
        o, e = o[:-1], e[:-1]
    if len(e) > 1:
        assert st.chi2.sf(((o - e) ** 2 / e).sum(), len(e) - 1) > LEVEL


@pytest.mark.parametrize("case", CASES, ids=lambda c: c.id)
def test_scalar_laws(case):
    made, theta = compiled(case)
    x, law = case.points(), case.reference
    expected = (law.logpmf if case.cls.discrete else law.logpdf)(x)
    found = made.log_density(theta, x[None])
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    check_sample(made.sample(theta, seed_of(case))[0], law, case.cls.discrete)


def marginals(case):
    """Flat index -> SciPy's law of that component."""
    p = case.parameters
    if case.cls is D.MvNormal:
        mean, cov = case.reference.mean, case.reference.cov
        return {i: st.norm(mean[i], math.sqrt(cov[i, i])) for i in range(len(mean))}
    if case.cls is D.Dirichlet:
        a = np.array(p["concentration"])
        return {i: st.beta(a[i], a.sum() - a[i]) for i in range(len(a))}
    if case.cls is D.LogisticNormal:
        return {}
    if case.cls is D.MvStudentT:
        sd = np.sqrt(np.diag(case.reference.shape))
        loc = case.reference.loc
        return {i: st.t(p["df"], loc[i], sd[i]) for i in range(len(sd))}
    scale, df = np.array(p["scale"]), p["df"]
    n = len(scale)
    if case.cls is D.Wishart:
        return {i * (n + 1): st.gamma(df / 2, scale=2 * scale[i, i]) for i in range(n)}
    return {i * (n + 1): st.invgamma((df - n + 1) / 2, scale=scale[i, i] / 2) for i in range(n)}


@pytest.mark.parametrize("case", JOINT_CASES, ids=lambda c: c.id)
def test_joint_laws(case):
    """Marginals of the compiled draws; the compiled log density at them; one linear functional."""
    made, theta = compiled(case)
    x = made.sample(theta, seed_of(case))
    for i, law in marginals(case).items():
        check_sample(x[i], law, False)
    few = x[:, :40]
    if case.cls in (D.Wishart, D.InverseWishart):
        n = len(case.parameters["scale"])
        shaped = few.T.reshape(-1, n, n)
        expected = [case.reference.logpdf(v) for v in shaped]
        # v' W v is gamma for each v, v' W^-1 v likewise: the off-diagonal entries count
        v, scale, df = np.arange(1.0, n + 1), np.array(case.parameters["scale"]), theta[0]
        w = x.T.reshape(-1, n, n)
        if case.cls is D.Wishart:
            form, law = w, st.gamma(df / 2, scale=2 * v @ scale @ v)
        else:
            form, law = np.linalg.inv(w), st.gamma(df / 2, scale=2 * v @ np.linalg.inv(scale) @ v)
        check_sample(np.einsum("i,tij,j->t", v, form, v), law, False)
    elif case.cls is D.Dirichlet:
        inside = np.all(few > 1e-280, axis=0)
        few = few[:, inside]
        few = few / few.sum(axis=0)  # SciPy asks for a sum of 1 to the last digit
        expected = [case.reference.logpdf(v[:-1]) for v in few.T]
    elif case.cls is D.LogisticNormal:
        expected = [case.reference.logpdf(v) for v in few.T]
        own, v = case.reference.ratios, np.arange(1.0, len(x))
        sd = math.sqrt(v @ np.atleast_2d(own.cov) @ v)
        check_sample(v @ np.log(x[:-1] / x[-1]), st.norm(v @ np.atleast_1d(own.mean), sd), False)
    elif case.cls is D.MvStudentT:
        expected, v = case.reference.logpdf(few.T), np.arange(1.0, len(x) + 1)
        sd = math.sqrt(v @ case.reference.shape @ v)
        check_sample(v @ x, st.t(case.parameters["df"], v @ case.reference.loc, sd), False)
    else:
        expected = case.reference.logpdf(few.T)
        v = np.arange(1.0, len(x) + 1)
        cov = np.atleast_2d(case.reference.cov)
        check_sample(v @ x, st.norm(v @ case.reference.mean, math.sqrt(v @ cov @ v)), False)
    np.testing.assert_allclose(made.log_density(theta, few), expected, rtol=1e-8, atol=1e-8)


_first = {}
for _case in TRUNCATED_CASES:
    _first.setdefault((_case.base.cls, len(_case.bounds())), _case)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(c, id=c.id, marks=[] if c in _first.values() else pytest.mark.slow)
        for c in TRUNCATED_CASES
    ],
)
def test_truncated_laws(case):
    """Density against SciPy; draws against the density's own distribution function."""
    made, theta = compiled(case.base, case.bounds())
    law, discrete = case.base.reference, case.base.cls.discrete
    x = made.sample(theta, seed_of(case))[0]
    assert np.all((x >= case.lower) & (x <= case.upper))
    few = np.unique(x[:50])
    expected = (law.logpmf if discrete else law.logpdf)(few) - case.log_mass()
    np.testing.assert_allclose(made.log_density(theta, few[None]), expected, rtol=1e-7, atol=1e-7)
    d = case.build()

    class Law:
        """The truncated law as the interpreter has it (tested in tests/language)."""

        @staticmethod
        def cdf(v):
            return evaluate(array(d.cdf(array(X)))[()], {X: np.asarray(v, dtype=float)})

        @staticmethod
        def pmf(v):
            return np.exp(evaluate(d.log_density(X), {X: np.asarray(v, dtype=float)}))

    check_sample(x, Law, discrete)


X = symbols("state", "x", ()).ravel()[0]


@pytest.mark.parametrize("name", COUNTS)
def test_counts_from_a_lower_bound_that_is_a_symbol(name):
    """One compiled sampler for bounds above, at and below 0."""
    base, law = COUNTS[name]
    bound = symbols("parameter", "bound", ()).ravel()[0]
    made = Compiled(D.Truncated(base, lower=bound), [bound])
    for at_least in (-3, 0, 1, 2):
        check_counts(made.sample(np.array([float(at_least)]), 10)[0], law, at_least)


# -- the whole way through `simulate`, for one law of each kind of randomness
ENTRY = {
    "normal": (D.StudentT, (4.0, 1.0), {"scale": 0.5}, st.t(4, 1.0, 0.5), False),
    "uniform": (D.Cauchy, (0.0,), {"scale": 2.0}, st.cauchy(0, 2), False),
    "gamma": (D.Gamma, (2.5,), {"rate": 2.0}, st.gamma(2.5, scale=0.5), False),
    "poisson": (D.Poisson, (7.0,), {}, st.poisson(7), True),
    "vonmises": (D.VonMises, (0.0,), {"concentration": 3.0}, st.vonmises(3.0), False),
    "binomial": (D.Binomial, (9.0, 0.3), {}, st.binom(9, 0.3), True),
}


@pytest.mark.parametrize("kind", ENTRY)
def test_simulate(kind):
    cls, args, spread, law, discrete = ENTRY[kind]
    model = declare(
        f"simulate {kind}",
        initial=lambda: {"x": cls(*args, **spread)},
        transition=lambda x: {"x": cls(*args, **spread)},
        observation=lambda x: {"y": D.Normal(x, sd=1e-3)},
    )
    program = compile_trace(trace(model))
    states, observations = np.empty((2, 1, N)), np.empty((2, 1, N))
    blank = np.zeros((2, 1))
    rng = new_state(np.random.SeedSequence(11))
    program.entry("simulate")(
        np.zeros(0), blank, blank + 1, np.zeros((2, 0)), rng, states, observations, False
    )
    for t in range(2):
        check_sample(states[t, 0], law, discrete)
    check_sample((observations - states).ravel() * 1e3, st.norm(), False)
    assert abs(np.corrcoef(st.rankdata(states[0, 0]), st.rankdata(states[1, 0]))[0, 1]) < 0.04
