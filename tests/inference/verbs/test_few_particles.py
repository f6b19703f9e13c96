"""Rows that next to no particle of a filter reaches are told, and others are not."""

import functools
import warnings

import numpy as np
import pytest
from scipy import optimize, stats

import ssmppl as ssm
from tests.statistics.checks import LEVEL, mean_one_p

AT = {"q": 0.1}


def precise(sd):
    model = ssm.Model("a precise sensor")
    model.prior(lambda: {"q": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, q: {"x": ssm.StudentT(4, x, scale=q)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=sd)})
    return model


def y(rows=8):
    return np.cumsum(0.1 * np.random.default_rng(3).standard_normal(rows))


@pytest.mark.parametrize("experiments", [1, 2])
def test_a_row_with_one_particle_is_told(experiments):
    tame = {"y": np.full(5, np.nan)}
    data = {"y": y(), "time": np.arange("2020-01", "2020-09", dtype="datetime64[M]")}
    given = data if experiments == 1 else [tame, {"y": y()}]
    with pytest.warns(UserWarning, match="particle degeneracy at t=") as said:
        found = ssm.particle_filter(
            precise(1e-6), given, AT, particles=100, proposal="bootstrap", seed=1
        )
    text = str(said[0].message)
    last = found[-1] if experiments == 2 else found
    row = int(last["ess"].argmin("time").item())
    assert f"t={row + 1} " in text
    assert f"of {float(last['ess'].min()):.1f} of 100 particles" in text
    assert f"below 3 at {int((last['ess'] < 3).sum()) - 1} other rows" in text
    assert ("of experiment 2" in text) is (experiments == 2)
    assert ("(time 2020-" in text) is (experiments == 1)
    assert text.endswith('proposal="auto"')
    assert last.attrs["filter_warning"] == text


def test_what_is_fine_is_not():
    """By default a filter that is tempered looks at rows that the transition does not reach."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = ssm.particle_filter(precise(1e-6), {"y": y()}, AT, particles=100, seed=1)
        few = ssm.particle_filter(
            precise(1e-6), {"y": y()}, AT, particles=10, proposal="bootstrap", seed=1
        )
        ssm.particle_filter(
            precise(0.1), {"y": y()}, AT, particles=100, proposal="bootstrap", seed=1
        )
    assert found.attrs["proposal"] == "tempered"
    assert "filter_warning" not in found.attrs
    assert "filter_warning" not in few.attrs


@functools.cache
def exact(q):
    """log p(y) of the transitions between the rows, which the sensor leaves next to no doubt of."""
    at = np.array([0.0, *y()])
    steps = stats.t(4, scale=q).logpdf(np.diff(at)[1:]).sum()
    return float(stats.norm(0, 1).logpdf(at[1]) + steps)


@pytest.mark.parametrize("sd", [1e-6, 1e-8])
def test_every_verb_takes_a_proposal_that_reaches_the_rows(sd):
    """Filter, smoother, score and maximum rested on one particle, with a log-likelihood of minus
    three hundred thousand; at 1e-8 no first temperature was small enough."""
    model, data = precise(sd), {"y": y()}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        smoothed = ssm.smooth(model, data, AT, seed=1)
        score = ssm.score(model, data, AT, seed=1)
        runs = ssm.particle_filter(model, data, AT, repeats=30, seed=1)
        best = ssm.maximize(model, data, seed=1)
    spread = smoothed["x"].std("trajectory").to_numpy() / sd
    np.testing.assert_allclose(spread, 1.0, atol=0.15)
    total = runs["log_likelihood_increment"].sum("time").to_numpy()
    assert mean_one_p(total.ravel() - exact(0.1)) > LEVEL
    error = score.log_likelihood_error
    assert score.log_likelihood == pytest.approx(exact(0.1), abs=5 * error)
    by = 1e-5
    slope = (exact(0.1 + by) - exact(0.1 - by)) / (2 * by)
    assert score.gradient["q"] == pytest.approx(slope, abs=5 * score.gradient_errors["q"] + 1e-3)
    q = optimize.minimize_scalar(
        lambda q: -exact(q), bounds=(0.01, 0.5), method="bounded"
    ).x  # fmt: skip
    assert best.parameters["q"] == pytest.approx(q, rel=0.01)
    error = best.attrs["log_likelihood_error"]
    assert best.log_likelihood == pytest.approx(exact(q), abs=5 * error)


@pytest.mark.parametrize("seed", [1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_steps_in_parameters_of_any_size(seed):
    """A spread of 1e-5, measured next to exactly: a step of the usual length in its mean was fifty
    thousand standard deviations, and the end had a log-likelihood of -1e13."""
    model = ssm.Model("spread")
    model.prior(lambda: {
        "phi": ssm.Beta(9, 1), "q": ssm.LogNormal(np.log(1e-5), sd=1), "mu": ssm.Normal(0, sd=1e-4)
    })  # fmt: skip
    model.initial(lambda mu: {"x": ssm.Normal(mu, sd=1e-4)})
    model.transition(lambda x, phi, q, mu: {"x": ssm.StudentT(4, mu + phi * (x - mu), scale=q)})
    model.observation(lambda x: {"bid": ssm.Normal(x, sd=1e-9)})
    rng = np.random.default_rng(4)
    x = [0.0]
    for _ in range(60):
        x.append(0.9 * x[-1] + 1e-5 * rng.standard_t(4))
    x = np.array(x[1:])

    def density(phi, q, mu):
        steps = stats.t(4, loc=mu + phi * (x[:-1] - mu), scale=q).logpdf(x[1:]).sum()
        return stats.norm(mu, 1e-4).logpdf(x[0]) + steps

    top = optimize.minimize(
        lambda z: -density(z[0], 1e-5 * np.exp(z[1]), 1e-5 * z[2]), [0.8, 0.0, 0.0],
        method="Nelder-Mead", options={"xatol": 1e-6, "fatol": 1e-9, "maxiter": 4000},
    )  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = ssm.maximize(model, {"bid": x}, seed=seed, progress=False)
    values = density(*(float(found.parameters[n]) for n in ("phi", "q", "mu")))
    assert -top.fun - 0.02 < values <= -top.fun + 1e-9
