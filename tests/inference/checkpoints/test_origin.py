"""What a checkpoint was made from: another model has another digest, the same one the same."""

import math

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.inference.checkpoints.origin import model_digest
from ssmppl.language.tracing import trace


def model(law, inputs=()):
    made = ssm.Model("of a law", inputs=inputs)

    @made.prior
    def prior():
        return {"q": ssm.LogNormal(0, sd=1)}

    @made.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @made.transition
    def transition(x, q):
        return {"x": ssm.Normal(0.5 * x, sd=1)}

    @made.observation
    def observation(x, q):
        return {"y": law(x, q)}

    return made


def own(lower, upper):
    def bell(v, q):
        return -0.5 * (v / q) ** 2

    return ssm.distribution(bell, lower=lower, upper=upper)


def own_with(part):
    """A mean, or a variance, by the same expression."""

    @ssm.distribution
    def bell(v, q):
        return -0.5 * (v / q) ** 2

    getattr(bell, part)(lambda q: q)
    return bell


SPREADS = ("sd", "variance", "precision")
EYE = np.eye(2)
ONE_OR_OTHER = {
    "normal": [lambda x, q, s=s: ssm.Normal(x, **{s: q}) for s in SPREADS],
    "gamma": [lambda x, q, s=s: ssm.Gamma(2, **{s: q}) for s in ("rate", "scale")],
    "exponential": [lambda x, q, s=s: ssm.Exponential(**{s: q}) for s in ("rate", "scale")],
    "truncated": [
        lambda x, q, s=s: ssm.Truncated(ssm.Normal(x, **{s: q}), lower=0) for s in SPREADS
    ],
    "mixed": [
        lambda x, q: ssm.Mixture([0.5, 0.5], [ssm.Normal(x, sd=q), ssm.Normal(x, sd=5)]),
        lambda x, q: ssm.Mixture([0.5, 0.5], [ssm.Normal(x, variance=q), ssm.Normal(x, sd=5)]),
        lambda x, q: ssm.Mixture([0.5, 0.5], [ssm.Laplace(x, scale=q), ssm.Normal(x, sd=5)]),
        lambda x, q: ssm.Mixture([0.5, 0.5], [ssm.Laplace(x, scale=q), ssm.Laplace(x, scale=5)]),
    ],
    "inflated": [
        lambda x, q: ssm.ZeroInflated(ssm.NegativeBinomial(q, dispersion=2), 0.1),
        lambda x, q: ssm.ZeroInflated(ssm.Truncated(ssm.Poisson(q), upper=2), 0.1),
        lambda x, q: ssm.ZeroInflated(ssm.Binomial(2, q), 0.1),
    ],
    "vectors": [
        lambda x, q, s=s: ssm.MvNormal(np.stack([x, x]), **{s: q * EYE + 0.1})
        for s in ("covariance", "precision")
    ],
    "bounds": [
        lambda x, q, b=b: own(*b)(q)
        for b in ((-math.inf, math.inf), (0.0, math.inf), (-math.inf, 1.0), (0.0, 1.0))
    ],
    "parts": [lambda x, q, p=p: own_with(p)(q) for p in ("mean", "variance")],
}  # fmt: skip


@pytest.mark.parametrize("name", ONE_OR_OTHER)
def test_laws_of_the_same_expressions_are_other_models(name):
    laws = ONE_OR_OTHER[name]
    first, again = ([model_digest(trace(model(law))) for law in laws] for _ in range(2))
    assert first == again
    assert len(set(first)) == len(laws)


def test_inputs_are_known_by_their_order():
    """As their columns are: with both changed places, the same numbers are another quantity's."""

    def law(x, q):
        return ssm.Normal(x, sd=1)

    made = [model_digest(trace(model(law, inputs=i))) for i in (("u", "w"), ("w", "u"))]
    assert made[0] != made[1]


def test_a_changed_spread_does_not_go_on(tmp_path):
    data = {"y": 3 * np.random.default_rng(0).normal(size=20)}
    settings = {"draws": 10, "warmup": 10, "chains": 1, "seed": 1, "progress": False}
    file = tmp_path / "a.npz"
    method = ssm.MetropolisHastings()
    sd, variance, *_ = ONE_OR_OTHER["normal"]
    ssm.sample(model(sd), data, method, checkpoint=file, **settings)
    before = file.read_bytes()
    with pytest.raises(ssm.ArgumentError, match="another model"):
        ssm.sample(model(variance), data, method, checkpoint=file, **settings)
    assert file.read_bytes() == before
    ssm.sample(model(sd), data, method, checkpoint=file, **settings)
