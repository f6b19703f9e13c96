"""Models of finitely many values, and their answers by enumerating every path."""

import functools
import itertools

import numpy as np
from scipy import stats

import ssmppl as ssm
from ssmppl.analysis.density import Missing, terms
from ssmppl.analysis.finite import finite_states
from ssmppl.errors import NotApplicable
from ssmppl.expressions.evaluate import evaluate
from ssmppl.inference.exact.kalman_matrices import values_of
from ssmppl.language.model.trace import previous, seen


def weather():
    """Two values, Gaussian readings, three parameters."""
    model = ssm.Model("weather")
    model.prior(lambda: {"stay": ssm.Beta(2, 1), "leave": ssm.Beta(1, 2), "m": ssm.Normal(1, sd=1)})
    model.initial(lambda leave: {"z": ssm.Bernoulli(leave)})
    model.transition(lambda z, stay, leave: {"z": ssm.Bernoulli(np.where(z, stay, leave))})
    model.observation(lambda z, m: {"y": ssm.Normal(m * z, sd=0.8)})
    return model


def patches():
    """Three values whose moves depend on an input and on time; counts and a vector that may be
    missing in part."""
    model = ssm.Model("patches", inputs=("u",))
    model.prior(lambda: {"a": ssm.Normal(0, sd=1), "rate": ssm.Gamma(2, rate=1)})
    model.initial(lambda: {"k": ssm.Categorical(np.array([0.2, 0.5, 0.3]))})

    def transition(k, u, t, a):
        odds = np.exp(np.stack([a * u, 0.3 * k, 0.1 * t]))
        return {"k": ssm.Categorical(odds / np.sum(odds))}

    model.transition(transition)
    model.observation(lambda k, rate: {
        "n": ssm.Poisson(rate * (k + 0.5)),
        "y": ssm.MvNormal(np.stack([k, -k]), covariance=np.array([[1.0, 0.6], [0.6, 2.0]])),
    })  # fmt: skip
    return model


def second_order():
    """A chain that remembers two steps, by a lagged copy; and one that hears its observation."""
    model = ssm.Model("second order")
    model.prior(lambda: {"p": ssm.Beta(1, 1), "e": ssm.Beta(1, 4)})
    model.initial(lambda: {"now": ssm.Bernoulli(0.5), "before": ssm.Dirac(0.0)})
    model.transition(lambda now, before, y, p, e: {
        "now": ssm.Bernoulli(np.where(now + before + y >= 2, p, 1.0 - p)), "before": ssm.Dirac(now),
    })  # fmt: skip
    model.observation(lambda now, e: {"y": ssm.Bernoulli(np.where(now, 1.0 - e, e))})
    return model


def nests():
    """Counts of few values with zeros of their own and a mixture of two laws; all observations are
    laws that are made of others, or have more scatter."""
    model = ssm.Model("nests")
    model.prior(lambda: {"zero": ssm.Beta(2, 2), "far": ssm.Beta(1, 4), "a": ssm.Gamma(2, rate=1)})
    model.initial(lambda zero: {"n": ssm.ZeroInflated(ssm.Binomial(2, 0.6), zero)})
    model.transition(lambda n, far, a: {
        "n": ssm.Mixture([1 - far, far], [ssm.BetaBinomial(2, 1.0 + n, a), ssm.Binomial(2, 0.5)])
    })  # fmt: skip
    model.observation(lambda n, zero, a, far: {
        "eggs": ssm.ZeroInflated(ssm.Poisson(1.0 + 2.0 * n), zero),
        "of": ssm.BetaBinomial(5, 1.0 + n, a),
        "y": ssm.Mixture([1 - far, far], [ssm.Normal(n, sd=0.5), ssm.Normal(0, sd=5)]),
    })  # fmt: skip
    return model


MODELS = {
    "nests": (nests, [0.3, 0.2, 1.7]),
    "weather": (weather, [0.9, 0.2, 1.4]),
    "patches": (patches, [0.7, 1.3]),
    "second order": (second_order, [0.8, 0.15]),
}


def data_of(name, steps=5):
    rng = np.random.default_rng(len(name))
    if name == "weather":
        y = rng.normal(0.5, 1.0, steps)
        y[2] = np.nan
        return {"y": y}
    if name == "nests":
        eggs, of = rng.poisson(2.0, steps).astype(float), rng.integers(0, 6, steps).astype(float)
        y = rng.normal(1.0, 2.0, steps)
        eggs[0], eggs[1], of[2], y[3] = 0.0, np.nan, np.nan, np.nan
        return {"eggs": eggs, "of": of, "y": y}
    if name == "patches":
        y, n = rng.normal(0.0, 1.5, (steps, 2)), rng.poisson(2.0, steps).astype(float)
        y[1, 0] = y[3] = n[0] = np.nan
        return {"n": n, "y": y, "u": rng.standard_normal(steps)}
    return {"y": rng.integers(0, 2, steps).astype(float)}


def enumerated(traced, e, theta):
    """(paths (M, T, D), log p(path, y) (M,)): every path there is, density by density."""
    form = finite_states(traced)
    assert not isinstance(form, NotApplicable)
    values, missing = form.values, Missing(partial=e.partial)
    given = values_of(traced, e, theta)

    @functools.cache
    def log_density(t, before, now):
        """Of x_t, the value of this number, and y_t, given that of x_{t-1}."""
        env = {s: (v[t] if np.ndim(v) else v) for s, v in given.items()}
        env |= dict(zip(traced.observation_symbols, e.y[t], strict=True))
        env |= {seen(s): m for s, m in zip(traced.observation_symbols, e.seen[t], strict=True)}
        env |= dict(zip(traced.state_symbols, values[now], strict=True))
        if t:
            earlier = [previous(s) for s in traced.state_symbols]
            env |= dict(zip(earlier, values[before], strict=True))
        roles = ("transition" if t else "initial", "observation")
        found = [term for role in roles for term in terms(traced, role, missing)]
        return sum(float(evaluate(term.guarded(), env)) for term in found)

    paths, total = [], []
    for index in itertools.product(range(len(values)), repeat=e.steps):
        pairs = zip((None, *index), index, strict=False)
        paths.append(values[list(index)])
        total.append(sum(log_density(t, *pair) for t, pair in enumerate(pairs)))
    return np.array(paths), np.array(total)


def independent(theta, y):
    """log p(y) of `weather` by matrices written by hand."""
    stay, leave, m = theta
    law = np.array([1.0 - leave, leave])
    move, total = np.array([[1.0 - leave, leave], [1.0 - stay, stay]]), 0.0
    for t, value in enumerate(y):
        law = law @ move if t else law
        if np.isfinite(value):
            law = law * stats.norm.pdf(value, [0.0, m], 0.8)
        total += np.log(law.sum())
        law = law / law.sum()
    return total
