"""The twisted proposal as expressions, run by the interpreter, against closed forms and quadrature.

A guide psi with any positive semidefinite precision will do here: what makes the filter right is
that moves and look-aheads belong to the same psi, not which psi it is.
"""

import numpy as np
import pytest
import scipy.stats as st

import ssmppl.language.distributions as D
from ssmppl.analysis.density import Missing, terms
from ssmppl.analysis.proposals.proposals import LARGEST_EXPONENT
from ssmppl.analysis.proposals.twisted import (
    DEFENSIVE,
    LookaheadModel,
    NoiseForm,
    jacobian,
    lookahead_model,
    noise_form,
    start_symbols,
    twisted,
    twisting_order,
    twisting_symbols,
)
from ssmppl.errors import NotApplicable
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import topological
from ssmppl.language.model.trace import previous, seen
from tests.analysis.proposals.test_proposals import model_of, total, values

COMPLETE = Missing(none=True)
Q = np.array([[0.8, 0.3], [0.3, 0.5]])
ROOT = np.array([[0.7, 0.0], [-0.4, 0.9]])


def numbers(array, known):
    """Values of an array of expressions."""
    found = np.array([float(evaluate(e, known)) for e in array.ravel()])
    return found.reshape(array.shape)


# -- laws by their noise
def one_of_each(x, v, m, s, k):
    """Transitions of each kind side by side, all of them depending on the past."""
    return {
        "x": D.MvNormal(np.stack([np.sin(x[0]), x[0] * x[1]]), precision=Q * np.exp(v)),
        "v": D.Normal(0.5 * v + x[1], variance=0.3 + x[0] ** 2),
        "m": D.Normal(np.stack([np.stack([v, x[0]]), m[1] ** 2]), sd=np.exp(m)),
        "s": D.LogNormal(np.log(s) / 2 + v, sd=0.4 + 0.1 * s),
        "k": D.Dirac(k + s * v),
    }


MIXED = (
    lambda: {"x": D.MvNormal(np.array([0.5, -0.5]), covariance=Q), "v": D.Normal(0.2, sd=0.7),
             "m": D.Normal(np.zeros((2, 2)), precision=3.0), "s": D.LogNormal(0.1, sd=0.3),
             "k": D.Dirac(1.5)},
    one_of_each,
    lambda x, v, s, k: {"y": D.Normal(x[0] * v + k, sd=s)},
)  # fmt: skip
LAWS = {
    "normal by sd": lambda x: {"x": D.Normal(np.tanh(x), sd=np.exp(x / 2))},
    "normal by variance": lambda x: {"x": D.Normal(x**2, variance=1 + x**2)},
    "normal by precision": lambda x: {"x": D.Normal(1 - x, precision=2 + np.sin(x))},
    "lognormal": lambda x: {"x": D.LogNormal(-0.5 * x, sd=0.3 + x**2)},
    "covariance": lambda x: {"x": D.MvNormal(x[::-1] ** 2, covariance=Q * np.exp(x[0]))},
    "precision": lambda x: {"x": D.MvNormal(np.sin(x), precision=Q * np.exp(x[0]))},
    "cholesky": lambda x: {"x": D.MvNormal(2 * x, cholesky=ROOT * np.exp(x[0]))},
}


def traced_of(name):
    """A trace with this transition, and a fully observed state."""
    if name == "mixed":
        return model_of(*MIXED)
    vector = name in ("covariance", "precision", "cholesky")
    start = np.zeros(2) if vector else 0.0
    return model_of(
        lambda: {"x": D.Normal(start, sd=1)}, LAWS[name], lambda x: {"y": D.Normal(x, sd=1)}
    )


def form_of(traced, role="transition"):
    found = noise_form(list(getattr(traced, role).values()), traced.state_symbols)
    assert isinstance(found, NoiseForm)
    return found


def past(traced, rng):
    """Values of x_{t-1}, positive where a law asks for it."""
    return {previous(s): abs(rng.normal()) + 0.3 if s.data[1] in "sk" else 0.5 * rng.normal()
            for s in traced.state_symbols}  # fmt: skip


def moved(form, traced, known, e):
    """x (D,) that noise e (R,) leads to."""
    return numbers(form.value, known | dict(zip(form.noise, e, strict=True)))


def slopes(function, at, step=1e-5):
    """Central differences, by column; their errors are about step^2 and 1e-16 / step."""
    columns = [(function(at + step * u) - function(at - step * u)) / (2 * step)
               for u in np.eye(len(at))]  # fmt: skip
    return np.array(columns).T.reshape(-1, len(at))


@pytest.mark.parametrize("role", ["initial", "transition"])
@pytest.mark.parametrize("name", [*LAWS, "mixed"])
def test_a_law_by_its_noise(name, role):
    """The noise is recovered, and the law's density is that of the noise by change of variables."""
    rng, traced = np.random.default_rng(1), traced_of(name)
    form, order = form_of(traced, role), traced.state_symbols
    sites = list(getattr(traced, role).values())
    noisy = {s for site in sites if not isinstance(site.distribution, D.Dirac)
             for s in site.value.ravel()}  # fmt: skip
    rows = [k for k, s in enumerate(order) if s in noisy]
    assert len(form.noise) == len(rows)
    for _ in range(5):
        known, e = past(traced, rng), rng.normal(size=len(form.noise))
        x = moved(form, traced, known, e)
        here = known | dict(zip(order, x, strict=True))
        np.testing.assert_allclose(numbers(form.recovered, here), e, atol=1e-12)
        volume = slopes(lambda e, known=known: moved(form, traced, known, e), e)[rows]
        log_f = sum(
            float(evaluate(t.log_density, here))
            for t in terms(traced, role)
            if not isinstance(t.site.distribution, D.Dirac)
        )
        expected = st.norm.logpdf(e).sum() - np.linalg.slogdet(volume)[1]
        assert log_f == pytest.approx(expected, abs=1e-7)
        for k, s in enumerate(order):
            if s not in noisy:
                assert x[k] == float(evaluate(form.value[k], known))


@pytest.mark.parametrize("name", [*LAWS, "mixed"])
def test_derivatives_of_a_law(name):
    rng, traced = np.random.default_rng(2), traced_of(name)
    form, before = form_of(traced), traced.state_prev_symbols
    spread, slope, rest = form.spread(), jacobian(form, traced), form.at_rest()
    none = np.zeros(len(form.noise))
    for _ in range(3):
        known = past(traced, rng)
        at = np.array([known[p] for p in before])

        def later(v):
            return moved(form, traced, dict(zip(before, v, strict=True)), none)

        np.testing.assert_allclose(numbers(rest, known), later(at), atol=1e-14)
        np.testing.assert_allclose(numbers(slope, known), slopes(later, at), atol=1e-7)
        expected = slopes(lambda e, known=known: moved(form, traced, known, e), none)
        np.testing.assert_allclose(numbers(spread, known), expected, atol=1e-7)


def test_no_noise_at_all():
    traced = model_of(
        lambda: {"p": D.Dirac(1.0), "v": D.Dirac(2.0)},
        lambda p, v: {"p": D.Dirac(p + v), "v": D.Normal(v, sd=1)},
        lambda p: {"y": D.Normal(p, sd=1)},
    )
    form = form_of(traced, "initial")
    assert form.noise == ()
    assert form.spread().shape == (2, 0)
    np.testing.assert_array_equal(numbers(form.at_rest(), {}), [1.0, 2.0])
    found = twisted(traced, COMPLETE)
    draws = [evaluate(found.initial_draw[s], {}) for s in traced.state_symbols]
    assert draws == [1.0, 2.0]
    symbols = (*traced.state_symbols, *traced.observation_symbols)
    known = dict(zip(symbols, (1.0, 2.0, 0.3), strict=True))
    assert float(total(found.initial_weight, known)) == pytest.approx(st.norm(1, 1).logpdf(0.3))


# -- the observation
@pytest.mark.parametrize("mask", [(1, 1, 1), (1, 0, 1), (0, 1, 0), (0, 0, 0)])
def test_slope_and_curvature_of_the_observation(mask):
    """Of a vector channel with single components missing, and of counts beside it."""
    traced = model_of(
        lambda: {"x": D.Normal(np.zeros(2), sd=1)},
        lambda x: {"x": D.Normal(x, sd=1)},
        lambda x: {"y": D.MvNormal(np.stack([np.sin(x[0]), x[0] * x[1]]), covariance=Q),
                   "n": D.Poisson(np.exp(x[1]))},
    )  # fmt: skip
    found = lookahead_model(traced, Missing(False, frozenset({"y"})))
    assert isinstance(found, LookaheadModel)
    assert not found.flat
    y, order = [0.4, -1.2, 2.0], traced.state_symbols
    known = values(traced, y=y, mask=mask)
    keep = np.flatnonzero(mask[:2])

    def log_g(x):
        out = mask[2] * st.poisson(np.exp(x[1])).logpmf(2)
        if len(keep):
            mean = np.array([np.sin(x[0]), x[0] * x[1]])[keep]
            out += st.multivariate_normal(mean, Q[np.ix_(keep, keep)]).logpdf(np.array(y)[keep])
        return np.atleast_1d(out)

    def slope(x):
        return slopes(log_g, x, 1e-4)[0]

    for at in np.array([[0.3, -0.8], [1.5, 0.7]]):
        here = known | dict(zip(order, at, strict=True))
        assert float(evaluate(found.observed, here)) == pytest.approx(log_g(at)[0], abs=1e-12)
        np.testing.assert_allclose(numbers(found.slope, here), slope(at), atol=1e-6)
        np.testing.assert_allclose(
            numbers(found.curvature, here), -slopes(slope, at, 1e-4), atol=1e-5
        )


def test_a_curvature_that_is_the_same_everywhere():
    traced = position(lambda p: {"y": D.Normal(2 * p + 1, sd=0.5)})
    assert lookahead_model(traced, COMPLETE).flat
    assert lookahead_model(
        traced, Missing()
    ).flat  # a missing row is no matter of where the state is
    assert not lookahead_model(position(lambda p: {"y": D.Normal(p**2, sd=0.5)}), COMPLETE).flat
    assert not lookahead_model(position(lambda p: {"y": D.Normal(p, sd=np.exp(p))}), COMPLETE).flat


# -- where there is none
def position(observation, initial=None, transition=None):
    """Position and velocity."""
    return model_of(
        initial or (lambda: {"p": D.Normal(0, sd=0.5), "v": D.Normal(0, sd=1)}),
        transition or (lambda p, v: {"p": D.Dirac(p + 0.5 * v), "v": D.Normal(0.9 * v, sd=0.3)}),
        observation,
    )


def see(p):
    return {"y": D.Normal(p, sd=1)}


def in_shape(p, v):
    return {"p": D.Dirac(p), "v": D.Normal(D.Gamma(np.exp(v), rate=1).cdf(2.0), sd=1)}


REASONS = {
    "no observation": ((None,), "there is no observation", ""),
    "flat start": (
        (see, lambda: {"p": D.Dirac(0.0), "v": D.Flat()}), "initial distribution of 'v' is Flat",
        "Flat()",
    ),
    "gamma start": (
        (see, lambda: {"p": D.Dirac(0.0), "v": D.Gamma(2, rate=1)}),
        "the distribution of v is Gamma", "D.Gamma(2",
    ),
    "gamma transition": (
        (see, None, lambda p, v: {"p": D.Dirac(p + v), "v": D.Gamma(2 + v, rate=1)}),
        "the distribution of v is Gamma, not driven by Gaussian noise", "D.Gamma(2 + v",
    ),
    "truncated": (
        (see, None,
         lambda p, v: {"p": D.Dirac(p + v), "v": D.Truncated(D.Normal(v, sd=1), lower=0)}),
        "the distribution of v is Truncated", "D.Truncated(",
    ),
    "no noise": (
        (see, None, lambda p, v: {"p": D.Dirac(p + v), "v": D.Dirac(0.9 * v)}),
        "no state has noise", "D.Dirac(0.9",
    ),
    "nothing observed": (
        (lambda: {"y": D.Normal(0.0, sd=1)},), "no state is observed", "D.Normal(0.0",
    ),
    "no derivative": (
        (see, None, in_shape), "the transition is not differentiable", "",
    ),
    "no derivative of the observation": (
        (lambda p: {"y": D.Truncated(D.Gamma(np.exp(p), rate=1), lower=1)},),
        "the observation is not twice differentiable", "D.Truncated(D.Gamma(",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REASONS)
def test_reasons(name):
    laws, words, line = REASONS[name]
    traced = position(*laws)
    found = twisted(traced, COMPLETE)
    assert isinstance(found, NotApplicable)
    assert words in found.reason
    if line:
        assert line in found.where.text
    assert lookahead_model(traced, COMPLETE).reason == found.reason


# -- the identities that make the filter right
def vector_with_a_follower():
    """Correlated noise of an affine law, a state that follows, others that scale the noise."""
    return model_of(
        lambda: {"x": D.MvNormal(np.array([0.5, -0.5]), covariance=Q), "k": D.LogNormal(0, sd=0.5)},
        lambda x, k: {"x": D.MvNormal(np.stack([np.sin(x[0]), k * x[1]]), covariance=Q * k),
                      "k": D.Dirac(0.5 + 0.1 * x[0])},
        lambda x, k: {"y": D.Normal(x[0] + k, sd=1)},
    )  # fmt: skip


AFFINE = {
    "autoregression": lambda: model_of(
        lambda: {"x": D.Normal(0.3, sd=0.8)}, lambda x: {"x": D.Normal(0.9 * x, sd=0.6)},
        lambda x: {"y": D.Poisson(np.exp(x))},
    ),
    "position": lambda: position(see),
    "spread by the state": lambda: model_of(
        lambda: {"x": D.Normal(0.3, sd=0.8)},
        lambda x: {"x": D.Normal(np.sin(x), precision=np.exp(-x))},
        lambda x: {"y": D.Normal(x, sd=1)},
    ),
    "vector": vector_with_a_follower,
}  # fmt: skip


def guide_of(traced, rng):
    """Symbol -> value of a random guide; A (D, D) of one rank less than full, g, m; and of the
    start mean (R,) and factor (R, R)."""
    d, r = len(traced.state_symbols), len(form_of(traced, "initial").noise)
    half = rng.normal(size=(d, max(d - 1, 1)))
    factor = np.tril(rng.normal(size=(r, r)), -1) + np.diag(rng.uniform(0.8, 2.0, r))
    parts = half @ half.T, rng.normal(size=d), rng.normal(size=d), rng.normal(size=r), factor
    known = {}
    for symbols, part in zip((*twisting_symbols(d), *start_symbols(r)), parts, strict=True):
        known |= {s: v for s, v in zip(symbols.ravel(), part.ravel(), strict=True)
                  if s.op == "symbol"}  # fmt: skip
    assert set(known) == set(twisting_order(d, r))
    return known, parts


def log_psi(x, parts):
    """Of x (D, n)."""
    a, g, m = parts[:3]
    away = x - m[:, None]
    return g @ away - 0.5 * np.einsum("in,ij,jn->n", away, a, away)


def noise_grid(r):
    """e (R, n), and the standard normal mass of each point: an integral by the trapezoidal rule,
    which is exact to rounding for what is smooth and vanishes at both ends."""
    axis, h = np.linspace(-13, 13, 600 if r > 1 else 4000, retstep=True)
    e = np.array(np.meshgrid(*[axis] * r, indexing="ij")).reshape(r, -1)
    return e, np.exp(st.norm.logpdf(e).sum(0)) * h**r


def at_noise(form, traced, known, e):
    """Symbol -> values (n,) of the states that noise e (R, n) leads to."""
    there = evaluate(list(form.value), known | dict(zip(form.noise, e, strict=True)))
    out = [np.broadcast_to(v, e.shape[1:]) for v in there]
    return dict(zip(traced.state_symbols, out, strict=True))


def log_ratio(weight):
    """log q / f, of which the last term of a weight is the negative."""
    return -weight[-1].log_density


def law_of_noise(form, known, parts):
    """Mean (R,) and precision (R, R) of e where psi stands beside its standard normal density."""
    a, g, m = parts[:3]
    spread, away = numbers(form.spread(), known), numbers(form.at_rest(), known) - m
    precision = np.eye(len(form.noise)) + spread.T @ a @ spread
    return np.linalg.solve(precision, spread.T @ (g - a @ away)), precision


@pytest.mark.parametrize("name", AFFINE)
def test_what_psi_can_be_expected_to_be(name):
    """The look-ahead is the log of the integral of psi under the transition, and q / f is psi over
    that, beside the transition's share; both integrate to one."""
    rng, traced = np.random.default_rng(3), AFFINE[name]()
    form, found = form_of(traced), twisted(traced, COMPLETE)
    e, mass = noise_grid(len(form.noise))
    for _ in range(4):
        guide, parts = guide_of(traced, rng)
        known = guide | past(traced, rng)
        x = at_noise(form, traced, known, e)
        psi = log_psi(np.array([*x.values()]), parts)
        ahead = float(evaluate(found.look_ahead, known))
        top = psi.max()
        assert ahead == pytest.approx(np.log(np.sum(mass * np.exp(psi - top))) + top, abs=1e-9)
        ratio = evaluate(log_ratio(found.weight), known | x)
        here = slice(None, None, 97)
        expected = np.log(DEFENSIVE + (1 - DEFENSIVE) * np.exp(psi[here] - ahead))
        np.testing.assert_allclose(ratio[here], expected, atol=1e-9)
        assert np.sum(mass * np.exp(ratio)) == pytest.approx(1.0, abs=1e-9)
        assert ratio.min() >= np.log(DEFENSIVE) - 1e-12  # so f / q is bounded


@pytest.mark.parametrize("role", ["initial", "transition"])
@pytest.mark.parametrize("name", [*LAWS, "mixed", *AFFINE])
def test_moves_have_the_law_that_they_are_weighed_by(name, role, monkeypatch):
    """Affine or not: what is drawn is, by its noise, a mixture of two Gaussians, and q / f is the
    mixture's density over the standard normal one."""
    monkeypatch.setattr("ssmppl.analysis.proposals.twisted.WRITTEN_OUT", 50)  # however many noises
    rng = np.random.default_rng(4)
    traced = AFFINE[name]() if name in AFFINE else traced_of(name)
    found, order, form = twisted(traced, COMPLETE), traced.state_symbols, form_of(traced, role)
    guide, parts = guide_of(traced, rng)
    known = guide | past(traced, rng)
    if role == "initial":
        draws, weight, mean = found.initial_draw, found.initial_weight, parts[3]
        precision = parts[4] @ parts[4].T
    else:
        draws, weight = found.draw, found.weight
        mean, precision = law_of_noise(form, known, parts)
    covariance, r = np.linalg.inv(precision), len(form.noise)
    roots = [draws[s] for s in order]
    normals = [n for n in topological(roots) if n.op == "random" and n.data[0] == "normal"]
    (uniform,) = (n for n in topological(roots) if n.op == "random" and n.data[0] == "uniform")
    assert len(normals) == r

    def noise_of(z, u):
        """Symbol -> value of the states drawn, and their noise."""
        numbers_drawn = dict(zip(normals, z, strict=True)) | {uniform: u}
        x = dict(zip(order, evaluate(roots, known | numbers_drawn), strict=True))
        return x, np.array([float(evaluate(k, known | x)) for k in form.recovered])

    below, above = np.nextafter(DEFENSIVE, [0.0, 1.0])
    for u, centre, spread in ((below, np.zeros(r), np.eye(r)), (above, mean, covariance)):
        rest = noise_of(np.zeros(r), u)[1]
        columns = np.array([noise_of(unit, u)[1] - rest for unit in np.eye(r)]).T
        np.testing.assert_allclose(rest, centre, atol=1e-10)
        np.testing.assert_allclose(columns @ columns.T, spread, atol=1e-9)
        z = rng.normal(size=r)
        x, e = noise_of(z, u)
        np.testing.assert_allclose(e, rest + columns @ z, atol=1e-9)  # affine in z
        for s in order:  # what has no noise follows
            site = getattr(traced, role)[s.data[1]]
            if isinstance(site.distribution, D.Dirac):
                assert x[s] == float(evaluate(site.distribution.mean()[s.data[2]], known))
        standard = st.norm.logpdf(e).sum()
        law = st.multivariate_normal(mean, covariance).logpdf(e)
        log_q = np.logaddexp(np.log(DEFENSIVE) + standard, np.log1p(-DEFENSIVE) + law)
        ratio = float(evaluate(log_ratio(weight), known | x))
        assert ratio == pytest.approx(log_q - standard, abs=1e-8)


@pytest.mark.parametrize("name", LAWS)
def test_a_guide_that_says_nothing(name):
    """Particles move by the transition, are not steered, and are weighed by the observation."""
    traced = traced_of(name)
    found, d, rng = twisted(traced, COMPLETE), len(traced.state_symbols), np.random.default_rng(6)
    flat = dict.fromkeys(twisting_order(d, len(form_of(traced, "initial").noise)), 0.0)
    _, factor = start_symbols(d)
    flat |= {factor[i, i]: 1.0 for i in range(d)}
    y = rng.normal(size=d)
    for weight, role in ((found.initial_weight, "initial"), (found.weight, "transition")):
        form = form_of(traced, role)
        known = flat | past(traced, rng) | dict(zip(traced.observation_symbols, y, strict=True))
        x = at_noise(form, traced, known, rng.normal(size=(d, 50)))
        expected = sum(st.norm(m, 1).logpdf(v) for m, v in zip(x.values(), y, strict=True))
        np.testing.assert_allclose(total(weight, known | x), expected, atol=1e-12)
    assert float(evaluate(found.look_ahead, known)) == pytest.approx(0.0, abs=1e-14)


def test_a_guide_far_from_the_transition():
    """Where exp(log q / f) has no number the weight is still right on the log scale."""
    traced = AFFINE["autoregression"]()
    found, (x,) = twisted(traced, COMPLETE), traced.state_symbols
    a, g, m = (s.ravel()[0] for s in twisting_symbols(1))
    # psi says that x is 60 with an sd of 0.1; the transition, 0.45 with an sd of 0.6
    known = {previous(x): 0.5, a: 100.0, g: 0.0, m: 60.0}
    psi = st.norm(60.0, 0.1)
    at = np.array([58.0, 59.9, 61.0])
    product = 1 / (1 / 0.36 + 100.0)
    q = st.norm(product * (0.45 / 0.36 + 6000.0), np.sqrt(product))
    expected = np.log(1 - DEFENSIVE) + q.logpdf(at) - st.norm(0.45, 0.6).logpdf(at)
    assert expected.min() > LARGEST_EXPONENT
    np.testing.assert_allclose(
        evaluate(log_ratio(found.weight), known | {x: at}), expected, rtol=1e-10
    )
    ahead = st.norm(0.45, np.hypot(0.6, 0.1)).logpdf(60.0) - psi.logpdf(60.0)
    assert float(evaluate(found.look_ahead, known)) == pytest.approx(ahead, rel=1e-10)


def test_weights_of_missing_rows():
    """What is not measured does not weigh; the guide weighs as before."""
    traced = position(see)
    found, rng = twisted(traced, Missing()), np.random.default_rng(7)
    guide, _ = guide_of(traced, rng)
    (y,) = traced.observation_symbols
    form = form_of(traced)
    known = guide | past(traced, rng) | {y: 0.4}
    x = at_noise(form, traced, known, rng.normal(size=(1, 9)))
    one, none = (total(found.weight, known | x | {seen(y): m}) for m in (1.0, 0.0))
    (p, _) = x.values()
    np.testing.assert_allclose(one - none, st.norm(p, 1).logpdf(0.4), atol=1e-12)
    np.testing.assert_allclose(none, -evaluate(log_ratio(found.weight), known | x), atol=1e-12)
