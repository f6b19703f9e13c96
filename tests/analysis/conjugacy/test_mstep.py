"""The M-step against the density as it was written."""

import numpy as np
import pytest
from scipy.optimize import minimize

from ssmppl.analysis.conjugacy.m_step import counted, derive_m_step
from ssmppl.analysis.conjugacy.numerical_check import random_series
from ssmppl.analysis.conjugacy.separation import complete_data
from ssmppl.data import unpack_parameters
from ssmppl.errors import NotApplicable
from ssmppl.expressions.evaluate import evaluate
from ssmppl.inference.updates.q_function import QFunction
from ssmppl.language.distributions import Gamma as GammaLaw
from ssmppl.language.distributions import Normal as NormalLaw
from ssmppl.language.distributions import Uniform
from ssmppl.language.model.model import Model
from ssmppl.language.model.transforms import transforms, unconstrain
from ssmppl.language.tracing import trace
from tests.analysis.conjugacy.corpus import CORPUS, build
from tests.statistics.checks import seed_of

ROWS = 30
NOT_SEPARABLE = {"negative_binomial", "student"}


class Written:
    """A random series of a model, its statistics, and its density as it was written."""

    def __init__(self, model, posterior, seed):
        self.trace = trace(model)
        self.data = counted(complete_data(self.trace), posterior)
        rng = np.random.default_rng(seed)
        rows = random_series(self.data, rng, ROWS)
        at = lambda v: v if np.ndim(v) == 0 else v[0]  # noqa: E731
        stacked = {s: np.array([at(row[s]) for row in rows]) for s in rows[-1] if s in rows[0]}
        later = {s: np.array([at(row[s]) for row in rows[1:]]) for s in rows[-1]}
        self.rows = {"prior": rows[0], "initial": rows[0], "transition": later}
        self.rows = {r: {s: at(v) for s, v in self.rows[r].items()} for r in ("prior", "initial")}
        self.rows |= {"transition": later, "observation": stacked}
        self.theta = np.array([self.rows["prior"][s] for s in self.trace.parameter_symbols])
        self.free = [c for t in transforms(self.trace) for c in t.free]

    def values(self, role, theta):
        return {**self.rows[role], **dict(zip(self.trace.parameter_symbols, theta, strict=True))}

    def log_density(self, theta):
        total = 0.0
        for role in self.rows:
            terms = [f.density for f in self.data.terms if f.role == role and not f.degenerate]
            size = ROWS if role == "observation" else ROWS - 1 if role == "transition" else 1
            for value in evaluate(terms, self.values(role, theta)):
                total += np.sum(np.broadcast_to(value, size))
        return total if np.isfinite(total) else -np.inf

    def statistics(self, step):
        total = np.zeros(len(step.update.functions))
        for role in self.rows:
            size = ROWS if role == "observation" else ROWS - 1 if role == "transition" else 1
            for i, c in enumerate(step.update.coefficients[role]):
                total[i] += np.sum(
                    np.broadcast_to(evaluate(c, self.values(role, self.theta)), size)
                )
        return total

    def constrain(self, z):
        known = dict(zip(self.free, z, strict=True))
        for t in transforms(self.trace):
            known |= dict(zip(t.components, evaluate(list(t.values), known), strict=True))
        return np.array([known[s] for s in self.trace.parameter_symbols])

    def searched(self, start):
        """The largest density that a search finds from here, on the unconstrained scale."""
        z = unconstrain(self.trace, start, unpack_parameters(self.trace, start))
        f = lambda v: min(-self.log_density(self.constrain(v)), 1e12)  # noqa: E731
        found = minimize(f, z, method="BFGS", options={"gtol": 1e-7})
        return -found.fun


@pytest.mark.parametrize("posterior", [False, True])
@pytest.mark.parametrize("name", sorted(set(CORPUS) - NOT_SEPARABLE))
def test_no_search_finds_a_larger_density(name, posterior):
    model, _, _ = build(name)
    written = Written(model, posterior, seed_of("m-step", name, posterior))
    step = derive_m_step(written.trace, posterior=posterior)
    assert step, step
    s, q = written.statistics(step), QFunction(step)
    theta = q.maximise(s, written.theta)
    reached, began = written.log_density(theta), written.log_density(written.theta)
    gain = q.value(s, theta) - q.value(s, written.theta)
    assert gain == pytest.approx(reached - began, abs=1e-8 * (1 + abs(reached)))
    for start in (written.theta, theta):
        assert reached >= written.searched(start) - 1e-6 * (1 + abs(reached)), (name, start)
    again = q.maximise(s, theta)
    np.testing.assert_allclose(again, theta, rtol=1e-6)


@pytest.mark.parametrize("name", sorted(NOT_SEPARABLE))
def test_what_does_not_separate_says_where(name):
    model, _, _ = build(name)
    found = derive_m_step(trace(model))
    assert isinstance(found, NotApplicable)
    assert "does not separate" in found.reason
    assert found.where.function == "observation"


def test_fixed_parameters_stay_and_the_others_are_told_by_them():
    model, _, _ = build("varves")
    written = Written(model, False, seed_of("fixed"))
    step = derive_m_step(written.trace, fixed=["phi"])
    theta = QFunction(step).maximise(written.statistics(step), written.theta)
    assert theta[0] == written.theta[0]
    assert theta[1] != written.theta[1]
    assert step.groups[0].closed


def test_bounds_of_another_parameter_bind():
    """b is bounded by a, whose own maximum is lower than where b would like to be."""
    model = Model("ordered")

    @model.prior
    def prior():
        return {"a": NormalLaw(0, sd=1), "tau": GammaLaw(1, rate=1)}

    @model.prior
    def second(a):
        return {"b": Uniform(-5.0, a)}

    @model.initial
    def initial():
        return {"x": NormalLaw(0, sd=1)}

    @model.transition
    def transition(x, a, tau):
        return {"x": NormalLaw(a, precision=tau)}

    @model.observation
    def observation(x, b):
        return {"y": NormalLaw(b, sd=1)}

    written = Written(model, False, seed_of("ordered"))
    index = {s.data[1]: i for i, s in enumerate(written.trace.parameter_symbols)}
    y = next(s for s in written.rows["observation"] if s.data[:2] == ("observation", "y"))
    written.rows["observation"][y] = written.rows["observation"][y] + 4.0
    step = derive_m_step(written.trace)
    theta = QFunction(step).maximise(written.statistics(step), written.theta)
    assert theta[index["b"]] < theta[index["a"]]
    reached = written.log_density(theta)
    assert reached > written.log_density(written.theta)
    assert reached >= written.searched(written.theta) - 1e-5 * abs(reached)
