"""R-hat and ESS held against ArviZ, and the rule by which chains have converged."""

from __future__ import annotations

import warnings

import arviz as az
import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.inference.preparation.method_choice import what_else
from ssmppl.inference.run.convergence import (
    bulk_ess,
    convergence_attributes,
    have_converged,
    rank_r_hat,
    tail_ess,
    unjudged,
)
from ssmppl.inference.run.draws import ChainDraws
from ssmppl.inference.run.problem import pose
from tests.models import standard as models


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
    assert tail_ess(draws) == pytest.approx(float(az.ess(draws, method="tail")), rel=1e-8)


SHORT = np.random.default_rng(3).standard_normal(12)
COUNTS = np.random.default_rng(3).poisson(3.0, 12)


walk = ssm.Model("walk")
walk.prior(lambda: {"q": ssm.InverseGamma(2, scale=0.01), "r": ssm.InverseGamma(2, scale=1)})
walk.initial(lambda: {"x": ssm.Normal(0, sd=3)})
walk.transition(lambda x, q: {"x": ssm.Normal(x, variance=q)})
walk.observation(lambda x, r: {"y": ssm.Normal(x, variance=r)})


def else_for(model, method, data=None, fixed=(), warmup=500) -> str:
    problem = pose(model, {"y": SHORT} if data is None else data)
    return what_else(method, problem, fixed, warmup)


def epidemic() -> ssm.Model:
    """Its states are counts, without noises that could be held fixed."""
    model = ssm.Model("epidemic")
    model.prior(lambda: {"beta": ssm.Gamma(2, rate=2)})
    model.initial(lambda: {"S": ssm.Poisson(90), "infected": ssm.Poisson(5)})
    model.transition(
        lambda S, infected, beta: {
            "new": ssm.Binomial(S, 1 - np.exp(-beta * infected / 100)),
            "healed": ssm.Binomial(infected, 0.3),
        }
    )
    model.transition(
        lambda S, infected, new_next, healed_next: {
            "S": ssm.Dirac(S - new_next), "infected": ssm.Dirac(infected + new_next - healed_next)
        }
    )  # fmt: skip
    model.observation(lambda infected: {"y": ssm.Poisson(infected + 0.1)})
    return model


def switching() -> ssm.Model:
    model = ssm.Model("switching")
    model.prior(lambda: {"p": ssm.Beta(2, 2)})
    model.initial(lambda: {"k": ssm.Bernoulli(0.5)})
    model.transition(lambda k, p: {"k": ssm.Bernoulli(np.where(k == 1, p, 1 - p))})
    model.observation(lambda k: {"y": ssm.Normal(k, sd=1.0)})
    return model


def noiseless() -> ssm.Model:
    model = ssm.Model("noiseless")
    model.prior(lambda: {"a": ssm.Normal(0, sd=1)})
    model.initial(lambda a: {"x": ssm.Dirac(a)})
    model.transition(lambda x, a: {"x": ssm.Dirac(0.9 * x + a)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    return model


@pytest.mark.parametrize(
    ("model", "method", "data", "fixed", "warmup", "named", "not_named"),
    [
        (walk, ssm.PGAS(), None, (), 500, 'ssm.PGAS(interweave="auto")', "warmup"),
        (walk, ssm.PGAS(), None, (), 50, "with warmup=200 or more", "PMMH"),
        (walk, ssm.Gibbs(interweave=False), None, (), 500, 'ssm.Gibbs(interweave="a', "M"),
        (walk, ssm.MetropolisHastings(), None, (), 500, "ssm.Gibbs()", "PGAS"),
        (epidemic, ssm.PGAS(), COUNTS, (), 500, "ssm.PMMH()", "interweave"),
        (epidemic, ssm.PMMH(), COUNTS, (), 500, "more particles", "interweave"),
        (switching, ssm.Gibbs(interweave=False), None, (), 500, "ssm.Metropolis", "interweave"),
        (noiseless, ssm.MetropolisHastings(), None, (), 500, "", "Gibbs"),
    ],
)  # fmt: skip
def test_only_what_the_model_can_is_advised(
    model, method, data, fixed, warmup, named, not_named
):  # fmt: skip
    model = model if isinstance(model, ssm.Model) else model()
    data = None if data is None else {"y": data}
    text = else_for(model, method, data, fixed, warmup)
    assert named in text
    assert not_named not in text


def test_nothing_is_interweaved_where_what_moves_the_states_is_held():
    problem = pose(walk, {"y": SHORT})
    assert "interweave" not in what_else(ssm.PGAS(), problem, problem.trace.parameters, 500)


def test_gibbs_is_what_is_chosen_without_a_method():
    """Draw for draw, interweaving included, on a model with a parameter that is slow without."""
    y = np.random.default_rng(5).standard_normal(100)
    settings = {"draws": 50, "warmup": 400, "chains": 1, "seed": 1, "progress": False}
    chosen = ssm.sample(walk, {"y": y}, **settings)
    given = ssm.sample(walk, {"y": y}, ssm.Gibbs(), **settings)
    plain = ssm.sample(walk, {"y": y}, ssm.Gibbs(interweave=False), **settings)
    assert chosen.attrs["method"] == "Gibbs"
    assert chosen["sample_stats"]["interweaved"].sum() > 0
    np.testing.assert_array_equal(chosen["posterior"]["q"], given["posterior"]["q"])
    assert "interweaved" not in plain["sample_stats"]


def warned(draws: np.ndarray, interrupted: bool = False, method=None) -> str:
    labels = [f"p{i}" for i in range(draws.shape[2])]
    advice = else_for(walk, ssm.PGAS() if method is None else method)
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        attrs = convergence_attributes(labels, draws, interrupted, advice, 500)
    text = str(found[0].message) if found else ""
    assert attrs.get("convergence_warning", "") == text
    return text


def test_the_worst_is_named():
    good, bad = chains(0.0, 400), chains(0.0, 400, apart=1.0)
    text = warned(np.stack([good, bad, good], axis=2))
    assert text.startswith("the chains have not converged: R-hat of p1 is 1.")
    assert f"bulk ESS {float(az.ess(bad)):.3g}" in text
    assert f"tail ESS {float(az.ess(bad, method='tail')):.3g}" in text
    assert "other" not in text.split(". ")[0]
    assert "different places: take a longer warmup (it was 500)" in text
    assert "1 other parameter falls short" in warned(np.stack([bad, good, bad], axis=2))


@pytest.mark.parametrize(
    ("rho", "n", "figure", "limit"),
    [(0.95, 1000, bulk_ess, 400.0), (0.9, 3000, rank_r_hat, 1.01), (0.0, 1000, tail_ess, 400.0)],
)
def test_each_figure_is_asked_for(rho: float, n: int, figure, limit: float):
    """Chains of which one figure misses the rule, and the other two do as far as they can."""
    draws = chains(rho, n, seed=5)
    if figure is rank_r_hat:
        draws = draws + 0.16 * np.arange(4)[:, None]
    if figure is tail_ess:
        # excursions to one side that last long: the centre hardly sees them
        draws = draws + np.where(np.arange(n) % 500 // 25 == 8, 4.0, 0.0)
    found = {f: f(draws) for f in (rank_r_hat, bulk_ess, tail_ess)}
    assert (found[figure] >= limit) if figure is rank_r_hat else (found[figure] < limit)
    assert warned(draws[:, :, None])
    others = [f for f in found if f is not figure]
    if figure is not bulk_ess:
        assert all(found[f] < 1.01 if f is rank_r_hat else found[f] >= 400.0 for f in others)


@pytest.mark.parametrize(("rho", "n"), [(0.9, 500), (0.97, 1500)])
def test_so_many_draws_would_do(rho: float, n: int):
    """What is advised is what such chains need, within what an estimate from short ones is off."""
    text = warned(chains(rho, n, seed=3)[:, :, None])
    wanted = int(text.split("draws=")[1].split()[0])
    needed = 400.0 / 4.0 * (1.0 + rho) / (1.0 - rho)
    assert 0.5 * needed < wanted < 4.0 * needed
    assert not warned(chains(rho, 2 * wanted, seed=4)[:, :, None])


def test_when_there_is_no_warning():
    good, bad = chains(0.0, 400), chains(0.0, 400, apart=1.0)
    assert not warned(good[:, :, None])
    assert not warned(bad[:, :, None], interrupted=True)
    assert not warned(bad[:, :99, None])
    assert not warned(np.empty((4, 400, 0)))
    assert not warned(np.ones((4, 400, 1)))


def test_what_has_an_error_of_its_own_is_not_judged():
    """`evidence` draws its proposal from chains, and counts their effective draws itself."""
    bad = chains(0.0, 400, apart=1.0)[:, :, None]
    with unjudged():
        assert not warned(bad)
    assert warned(bad)
    data = {"y": ssm.simulate(models.stationary, steps=30, seed=1)["y"].values[0]}
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        ssm.evidence(models.stationary, data, draws=100, warmup=50, seed=1, progress=False)


def test_one_chain_has_no_r_hat():
    assert "one chain has no R-hat" in warned(chains(0.0, 400, m=1)[:, :, None])


@pytest.mark.parametrize("far", [False, True])
def test_chains_go_on_by_the_rule_of_the_warning(far: bool):
    draws = chains(0.95 if far else 0.0, 1000, seed=5)[:, :, None]
    free = np.array([False, True])
    theta = np.concatenate([chains(0.99, 1000)[:, :, None], draws], axis=2)  # the first is fixed
    each = [ChainDraws({"theta": t}, {}, {}, None) for t in theta]
    assert have_converged(each, free) is not far
    assert bool(warned(draws)) is far


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
    with pytest.warns(UserWarning, match="have not converged"):
        idata = ssm.sample(
            model,
            data,
            ssm.MetropolisHastings(covariance=1e-4 * np.eye(2)),
            draws=200,
            warmup=0,
            **settings,
        )
    assert "R-hat of" in idata.posterior.attrs["convergence_warning"]
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        idata = ssm.sample(model, data, fixed={"b": 0.0}, draws=1000, warmup=500, **settings)
    assert "convergence_warning" not in idata.posterior.attrs
