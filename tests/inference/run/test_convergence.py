"""R-hat and ESS held against ArviZ, and the warning of chains that have not mixed."""

from __future__ import annotations

import warnings

import arviz as az
import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.inference.run.convergence import bulk_ess, mixing_attributes, rank_r_hat
from ssmppl.inference.verbs.sample import METHODS


def chains(rho: float, n: int, apart: float = 0.0, seed: int = 1, m: int = 4) -> np.ndarray:
    """(m, n) of an AR(1) of variance one, the chains' means `apart` from each other."""
    rng = np.random.default_rng(seed)
    out = np.empty((m, n))
    out[:, 0] = rng.standard_normal(m)
    for t in range(1, n):
        out[:, t] = rho * out[:, t - 1] + np.sqrt(1 - rho**2) * rng.standard_normal(m)
    return out + apart * np.arange(m)[:, None]


CASES = {
    "independent": chains(0.0, 400),
    "slow": chains(0.97, 1000),
    "alternating": chains(-0.6, 501),
    "apart": chains(0.5, 301, apart=1.0),
    "other spread": chains(0.3, 400) * np.array([1.0, 1.0, 1.0, 5.0])[:, None],
    "refusals": np.repeat(chains(0.2, 100), 5, axis=1),
    "two chains": chains(0.9, 200, m=2),
}


@pytest.mark.parametrize("case", list(CASES))
def test_figures_are_those_of_arviz(case: str):
    draws = CASES[case]
    assert rank_r_hat(draws) == pytest.approx(float(az.rhat(draws)), rel=1e-10)
    assert bulk_ess(draws) == pytest.approx(float(az.ess(draws)), rel=1e-8)


def warned(draws: np.ndarray, interrupted: bool = False, method=None) -> str:
    labels = [f"p{i}" for i in range(draws.shape[2])]
    method = ssm.PGAS() if method is None else method
    advice = METHODS[type(method)].advice(method)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        attrs = mixing_attributes(labels, draws, interrupted, advice, 500)
    text = str(found[0].message) if found else ""
    assert attrs.get("mixing_warning", "") == text
    return text


def test_the_worst_is_named():
    good, bad = chains(0.0, 400), chains(0.0, 400, apart=1.0)
    text = warned(np.stack([good, bad, good], axis=2))
    assert text.startswith("the chains have not mixed: R-hat of p1 is 1.")
    assert f"bulk ESS {float(az.ess(bad)):.3g}" in text
    assert "other" not in text.split(". ")[0]
    assert "400 of each chain" in text
    assert "warmup (500)" in text
    assert "1 other parameter also fails" in warned(np.stack([bad, good, bad], axis=2))


def test_too_few_independent_draws():
    """Long enough together in one place, so that R-hat alone would not tell."""
    slow = chains(0.95, 1000, seed=5)
    assert rank_r_hat(slow) < 1.05
    assert bulk_ess(slow) < 100.0
    assert warned(slow[:, :, None]).startswith("effective sample size too small")


def test_when_there_is_no_warning():
    good, bad = chains(0.0, 400), chains(0.0, 400, apart=1.0)
    assert not warned(good[:, :, None])
    assert not warned(bad[:, :, None], interrupted=True)
    assert not warned(bad[:, :99, None])
    assert not warned(bad[:1, :, None])
    assert not warned(np.empty((4, 400, 0)))
    assert not warned(np.ones((4, 400, 1)))


def test_chains_that_stand_still_apart():
    assert "R-hat of p0 is inf" in warned(np.ones((4, 400, 1)) * np.arange(4)[:, None, None])


def test_what_to_do_depends_on_the_method():
    bad = chains(0.0, 400, apart=1.0)[:, :, None]
    assert 'ssm.Gibbs(interweave="auto")' in warned(bad, method=ssm.Gibbs(interweave=False))
    assert "more particles" in warned(bad, method=ssm.PMMH())
    assert "ssm.Gibbs()" in warned(bad, method=ssm.MetropolisHastings())


def test_sample_warns_and_keeps_the_warning():
    """Two parameters of which the data tell the sum: a short random walk cannot mix."""
    model = ssm.Model("sum")
    model.prior(lambda: {"a": ssm.Normal(0, sd=100), "b": ssm.Normal(0, sd=100)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.5 * x, sd=1)})
    model.observation(lambda x, a, b: {"y": ssm.Normal(x + a + b, sd=1)})
    data = {"y": np.random.default_rng(1).standard_normal(30)}
    settings = {"seed": 1, "progress": False, "states": False}
    with pytest.warns(UserWarning, match="mixed|sample size too small"):
        idata = ssm.sample(
            model,
            data,
            ssm.MetropolisHastings(covariance=1e-4 * np.eye(2)),
            draws=200,
            warmup=0,
            **settings,
        )
    assert "R-hat of" in idata.posterior.attrs["mixing_warning"]
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        idata = ssm.sample(model, data, fixed={"b": 0.0}, draws=1000, warmup=500, **settings)
    assert "mixing_warning" not in idata.posterior.attrs
