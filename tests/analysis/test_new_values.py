"""Laws that read new values of other states: every algorithm against answers by hand."""

from pathlib import Path

import numpy as np
import pytest
from scipy import optimize, special, stats

import ssmppl as ssm
from ssmppl.analysis.new_values import in_order
from ssmppl.analysis.proposals.proposals import split
from ssmppl.analysis.structure import gaussian_block, linear_gaussian
from ssmppl.datasets import boarding_school
from ssmppl.errors import ArgumentError, NotApplicable
from ssmppl.language.tracing import trace
from ssmppl.modelfile import load_model, read_csv
from tests.models import new_values as models
from tests.statistics.checks import (
    LEVEL,
    MCSE,
    assert_within,
    deviations,
    mcse_mean,
    mean_one_p,
    seed_of,
    some,
)

EXAMPLES = Path(__file__).parents[2] / "examples"
THETA = {"a": 0.6, "rho": 0.9, "q": 0.3}
SHARES = {"p": 0.4, "r": 0.7}
STEPS = {"correlated": 8, "counts": 5, "regimes": 6, "volatility": 4}
PARAMETERS = {"correlated": THETA, "counts": SHARES, "regimes": {}, "volatility": {}}


def rows_of(name):
    model = getattr(models, name)
    seed = seed_of("new values", name)
    drawn = ssm.simulate(model, PARAMETERS[name], steps=STEPS[name], seed=seed)
    data = {channel: drawn[channel].values[0].copy() for channel in trace(model).observations}
    if name == "correlated":
        data["y"][2] = np.nan
    return data


DATA = {name: rows_of(name) for name in STEPS}


def log_evidence(name):
    data = DATA[name]
    if name == "correlated":
        return models.correlated_answer(THETA, **data)[0]
    if name == "counts":
        return special.logsumexp(models.counts_paths(SHARES, data["y"])[1])
    if name == "regimes":
        return models.regimes_answer(data["y"])[0]
    return models.volatility_answer(data["y"], points=24)


# -- what is derived
def test_a_linear_gaussian_model_stays_one_and_is_exact():
    found = ssm.log_likelihood(models.correlated, DATA["correlated"], THETA)
    assert found[0] == pytest.approx(log_evidence("correlated"), abs=1e-10)
    _, mean, sd = models.correlated_answer(THETA, **DATA["correlated"])
    smoothed = ssm.smooth(models.correlated, DATA["correlated"], THETA)
    for k, name in enumerate(("v", "x", "lag")):
        np.testing.assert_allclose(smoothed[name].values[0], mean[:, k], atol=1e-9)
        np.testing.assert_allclose(smoothed[f"{name}_sd"].values[0], sd[:, k], atol=1e-7)


def test_the_score_is_that_of_the_dense_law():
    found = ssm.score(models.correlated, DATA["correlated"], THETA).gradient
    for name in THETA:
        up, down = ({**THETA, name: THETA[name] + h} for h in (1e-5, -1e-5))
        ends = [models.correlated_answer(th, **DATA["correlated"])[0] for th in (up, down)]
        assert found[name] == pytest.approx((ends[0] - ends[1]) / 2e-5, abs=1e-6)


@pytest.mark.parametrize("proposal", ["laplace", "extended", "unscented"])
def test_gaussian_approximations_are_exact_where_the_model_is(proposal):
    found = ssm.log_likelihood(
        models.correlated, DATA["correlated"], THETA, proposal=proposal, seed=1
    )
    assert found[0] == pytest.approx(log_evidence("correlated"), abs=1e-8)


def test_laplace_is_that_of_the_noises():
    """By a minimiser that knows only the density of the noises, and differences of it."""
    y = DATA["volatility"]["y"]

    def energy(e):
        (h, x), total = e[:2], 0.5 * e @ e
        for t, value in enumerate(y):
            if t:
                new = 0.8 * h + 0.4 * e[2 * t]
                x = 0.9 * x + 0.5 * (new - 0.8 * h) + np.exp(0.5 * new) * e[2 * t + 1]
                h = new
            total += 0.5 * ((value - x) / 0.3) ** 2 + np.log(0.3 * np.sqrt(2 * np.pi))
        return total

    n, h = 2 * len(y), 1e-4
    mode = optimize.minimize(energy, np.zeros(n), method="BFGS", options={"gtol": 1e-9}).x
    step = h * np.eye(n)
    curvature = [
        [energy(mode + a + b) - energy(mode + a - b) - energy(mode - a + b) + energy(mode - a - b)
         for a in step] for b in step
    ]  # fmt: skip
    _, log_det = np.linalg.slogdet(np.array(curvature) / (4 * h * h))
    found = ssm.log_likelihood(models.volatility, {"y": y}, {}, proposal="laplace")
    assert found[0] == pytest.approx(-energy(mode) - 0.5 * log_det, abs=1e-5)


def test_a_product_of_an_old_and_a_new_value_is_not_linear():
    model = ssm.Model("product")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "z": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.transition(lambda z, x_next: {"z": ssm.Normal(z * x_next, sd=1)})
    model.observation(lambda z: {"y": ssm.Normal(z, sd=1)})
    assert isinstance(linear_gaussian(trace(model)), NotApplicable)


def test_what_is_not_affine_in_a_new_value_is_no_part_of_the_block():
    traced = trace(models.volatility)
    block = gaussian_block(list(traced.transition.values()))
    assert [repr(s) for s in block.symbols] == ["h"]
    (site, reason) = block.late[0]
    assert site.name == "x"
    assert "the spread of the transition of x depends on the new value of h" in reason.reason
    # x is observed: h is drawn first, and x proposed given it
    parts = split(traced, list(traced.transition.values()))
    assert [repr(s) for s in parts.gaussian.symbols] == ["x"]
    assert [repr(s) for s in parts.others] == ["h"]


def test_the_order_of_laws():
    sites = trace(models.correlated).transition
    assert list(sites) == ["shock", "x", "v", "lag"]
    shuffled = {name: sites[name] for name in ("lag", "v", "x", "shock")}
    assert list(in_order(shuffled)) == ["shock", "x", "lag", "v"]
    assert list(in_order(sites)) == list(sites)


def test_what_follows_from_a_new_value_keeps_that_from_moving_by_itself():
    with pytest.raises(
        ArgumentError, match="distribution of 'lag' is Dirac and follows from states of the"
    ):
        ssm.log_likelihood(models.correlated, DATA["correlated"], THETA, proposal="tempered")


# -- likelihoods
UNBIASED = [
    ("correlated", "bootstrap"), ("correlated", "guided"), ("correlated", "auxiliary"),
    ("correlated", "twisted"), ("counts", "bootstrap"), ("regimes", "bootstrap"),
    ("regimes", "guided"), ("regimes", "marginal"), ("volatility", "bootstrap"),
    ("volatility", "guided"), ("volatility", "twisted"), ("volatility", "marginal"),
    pytest.param("volatility", "marginal_guided", marks=pytest.mark.slow),
    pytest.param("volatility", "marginal_auxiliary", marks=pytest.mark.slow),
    pytest.param("volatility", "tempered", marks=pytest.mark.slow),
]  # fmt: skip


@pytest.mark.parametrize(("name", "proposal"), UNBIASED)
def test_particle_estimates_are_unbiased(name, proposal):
    found = ssm.log_likelihood(
        getattr(models, name), DATA[name], PARAMETERS[name], particles=60, repeats=2000,
        proposal=proposal, seed=seed_of("unbiased", name, proposal),
    )  # fmt: skip
    p = mean_one_p(found - log_evidence(name))
    print(f"{name} {proposal}: sd {found.std():.3f}, p = {p:.3f}")
    assert found.std() > 0.0
    assert p > LEVEL / len(UNBIASED)


def test_finite_values_are_summed_exactly():
    found = ssm.log_likelihood(models.counts, DATA["counts"], SHARES)
    assert found[0] == pytest.approx(log_evidence("counts"), abs=1e-10)


# -- trajectories
def test_simulated_rows_have_the_joint_law():
    steps, draws = 3, 20_000
    drawn = ssm.simulate(
        models.correlated, THETA, steps=steps, draws=draws, seed=seed_of("simulated")
    )
    x = np.stack([drawn[n].values for n in ("v", "x", "lag")], axis=2).reshape(draws, -1)
    exact = models.correlated_moments(THETA, steps)
    product = x[:, :, None] * x[:, None, :]
    spread = np.sqrt(np.outer(np.diag(exact), np.diag(exact)) + exact**2)  # of a product
    with np.errstate(invalid="ignore"):
        z = np.where(spread > 0, (product.mean(0) - exact) / spread * np.sqrt(draws), 0.0)
    assert np.abs(z).max() < 4.5  # 45 products


@pytest.mark.parametrize("method", ["PGAS", pytest.param("FFBSi", marks=pytest.mark.slow)])
def test_paths_of_counts(method):
    """The means of all states given all data, by every path there is; PGAS is exact with any number
    of particles."""
    paths, log_p = models.counts_paths(SHARES, DATA["counts"]["y"])
    exact = np.einsum("m,mti->ti", np.exp(log_p - special.logsumexp(log_p)), paths)
    chosen = ssm.PGAS(particles=8) if method == "PGAS" else ssm.FFBSi(proposal="bootstrap")
    several = [
        ssm.smooth(
            models.counts, DATA["counts"], SHARES, chosen, trajectories=2000,
            particles=None if method == "PGAS" else 2000, seed=seed_of("paths", method, k),
        )
        for k in range(8)
    ]  # fmt: skip
    for i, name in enumerate(("n", "k", "leave")):
        means = np.array([one[name].values.mean(axis=0) for one in several])
        assert np.isnan(means[:, 0]).all() == (name == "leave")
        for t in range(1, STEPS["counts"]):
            error = means[:, t].std(ddof=1) / np.sqrt(len(several))
            assert abs(means[:, t].mean() - exact[t, i]) < 5.4 * error, (name, t)  # t, 7 d.o.f.


@pytest.mark.parametrize(
    "proposal", ["bootstrap", pytest.param("marginal", marks=pytest.mark.slow)]
)
def test_paths_of_regimes(proposal):
    """Backward simulation, with z and x integrated out too, where their law reads the regime that
    the step leads to."""
    _, exact = models.regimes_answer(DATA["regimes"]["y"])
    several = [
        ssm.smooth(
            models.regimes, DATA["regimes"], {}, ssm.FFBSi(proposal=proposal), particles=1500,
            trajectories=500, seed=seed_of("regimes", proposal, k),
        )
        for k in range(8)
    ]  # fmt: skip
    for i, name in enumerate(("s", "x", "z")):
        means = np.array([one[name].values.mean(axis=0) for one in several])
        error = means.std(axis=0, ddof=1) / np.sqrt(len(several))
        off = np.abs(means.mean(axis=0) - exact[:, i])
        assert np.all(off < 5.4 * error + 0.002), (name, off / error)  # bias of order 1 / particles


# -- parameters
METHODS = {
    "PGAS": ssm.PGAS(particles=8),
    "Gibbs": ssm.Gibbs(),
    "PGAS without them": ssm.PGAS(particles=8, eliminate=True),
    "PMMH": ssm.PMMH(particles=40, proposal="bootstrap"),
}


@pytest.fixture(scope="module")
def posterior():
    return models.counts_posterior(DATA["counts"]["y"])


@pytest.mark.parametrize("name", some(METHODS, 2))
def test_posteriors(name, posterior):
    idata = ssm.sample(
        models.counts, DATA["counts"], METHODS[name], draws=3000, warmup=200, chains=2,
        seed=seed_of("posterior", name), progress=False,
    )  # fmt: skip
    found = {}
    for p, mean in posterior.items():
        found[p] = deviations(idata["posterior"][p].values, mean=mean)["mean"]
    assert_within(found, MCSE)


@pytest.mark.slow
def test_em_climbs_to_the_maximum_of_the_likelihood():
    rows = ssm.simulate(models.correlated, THETA, steps=60, seed=seed_of("em"))
    data = {n: rows[n].values[0] for n in ("y", "w")}
    call = {"start": {"a": 0.5, "rho": 0.5}, "fixed": {"q": 0.3}}  # whose maximum may be 0
    top = ssm.maximize(models.correlated, data, **call)
    em = ssm.maximize(models.correlated, data, ssm.EM(), **call)
    assert em.log_likelihood == pytest.approx(top.log_likelihood, abs=1e-6)


# -- epidemics
def epidemic(flows):
    """Influenza in a boarding school, with the flows of a day by this function."""
    model = ssm.Model("flu")
    model.prior(lambda: {"beta": ssm.LogNormal(0.4, sd=0.5), "recover": ssm.Beta(2, 2)})
    model.initial(lambda: {"S": ssm.Dirac(760), "I": ssm.Dirac(3)})
    model.transition(flows)

    @model.transition
    def boys(S, I, infected_next, recovered_next):
        return {
            "S": ssm.Dirac(S - infected_next),
            "I": ssm.Dirac(I + infected_next - recovered_next),
        }

    model.observation(lambda I: {"in_bed": ssm.Poisson(I + 0.1)})
    return model


def mean_flows(S, I, beta, recover):
    return {
        "infected": ssm.Dirac(S * (1 - np.exp(-beta * I / 763))),
        "recovered": ssm.Dirac(I * recover),
    }


def drawn_flows(S, I, beta, recover):
    return {"infected": ssm.Binomial(S, 1 - np.exp(-beta * I / 763)),
            "recovered": ssm.Binomial(I, recover)}  # fmt: skip


def lagged_epidemic():
    """The same epidemic with the flows as states, which the next step carries out."""
    model = ssm.Model("lagged flu")
    model.prior(lambda: {"beta": ssm.LogNormal(0.4, sd=0.5), "recover": ssm.Beta(2, 2)})
    zero = {n: ssm.Dirac(0) for n in ("infected", "recovered")}
    model.initial(lambda: {"S": ssm.Dirac(760), "I": ssm.Dirac(3), **zero})

    @model.transition
    def step(S, I, infected, recovered, beta, recover):
        s, i = S - infected, I + infected - recovered
        return {"S": ssm.Dirac(s), "I": ssm.Dirac(i),
                "infected": ssm.Binomial(s, 1 - np.exp(-beta * i / 763)),
                "recovered": ssm.Binomial(i, recover)}  # fmt: skip

    @model.observation
    def in_bed(I, infected, recovered):
        return {"in_bed": ssm.Poisson(I + infected - recovered + 0.1)}

    return model


FLU = {"beta": 2.3, "recover": 0.47}


def test_an_epidemic_without_chance_is_run_once():
    y = boarding_school()
    s, i, exact = 760.0, 3.0, 0.0
    for t, value in enumerate(y):
        if t:
            infected, recovered = s * (1 - np.exp(-FLU["beta"] * i / 763)), FLU["recover"] * i
            s, i = s - infected, i + infected - recovered
        exact += stats.poisson.logpmf(value, i + 0.1)
    model = epidemic(mean_flows)
    assert list(trace(model).initial) == ["S", "I"]
    found = ssm.log_likelihood(model, {"in_bed": y}, FLU)
    assert found[0] == pytest.approx(exact, abs=1e-8)


def test_flows_drawn_first_are_the_lagged_form():
    """Both estimates are unbiased for the same likelihood."""
    data = {"in_bed": boarding_school()[:6]}
    one, two = (
        ssm.log_likelihood(model, data, FLU, particles=300, repeats=200, seed=seed_of("flu", k))
        for k, model in enumerate((epidemic(drawn_flows), lagged_epidemic()))
    )
    top = max(one.max(), two.max())
    one, two = np.exp(one - top), np.exp(two - top)
    error = np.sqrt(one.var(ddof=1) / len(one) + two.var(ddof=1) / len(two))
    assert abs(one.mean() - two.mean()) < MCSE * error
    assert error < 0.1 * one.mean()


@pytest.mark.slow
@pytest.mark.exhaustive
def test_flows_drawn_first_have_the_posterior_of_the_lagged_form():
    """The SEIR example, and its earlier form with the flows as states of their own."""
    data = read_csv(EXAMPLES / "seir" / "data.csv")[["reported"]]
    drawn = [
        ssm.sample(
            model, data, ssm.PMMH(particles=150), draws=1000, warmup=500, chains=4,
            seed=seed_of("seir", k), progress=False, states=False,
        )["posterior"]
        for k, model in enumerate((load_model(str(EXAMPLES / "seir" / "model.py")), lagged_seir()))
    ]  # fmt: skip
    for name in ("beta", "fall_ill", "recover", "rho"):
        one, two = (np.asarray(d[name].values) for d in drawn)
        for values in ((one, two), ((one - one.mean()) ** 2, (two - two.mean()) ** 2)):
            error = np.hypot(*(mcse_mean(v) for v in values))
            assert abs(values[0].mean() - values[1].mean()) < MCSE * error, name


def lagged_seir():
    model = ssm.Model("lagged SEIR")
    model.prior(lambda: {
        "beta": ssm.LogNormal(np.log(0.6), sd=0.5), "fall_ill": ssm.Beta(20, 40),
        "recover": ssm.Beta(20, 60), "rho": ssm.Beta(2, 2),
    })  # fmt: skip
    zero = {n: ssm.Dirac(0) for n in ("I", "infected", "onsets", "recovered")}
    model.initial(lambda: {"S": ssm.Dirac(795), "E": ssm.Dirac(5), **zero})

    @model.transition
    def step(S, E, I, infected, onsets, recovered, beta, fall_ill, recover):
        s, e, i = S - infected, E + infected - onsets, I + onsets - recovered
        return {
            "S": ssm.Dirac(s), "E": ssm.Dirac(e), "I": ssm.Dirac(i),
            "infected": ssm.Binomial(s, 1 - np.exp(-beta * i / 800)),
            "onsets": ssm.Binomial(e, fall_ill), "recovered": ssm.Binomial(i, recover),
        }  # fmt: skip

    model.observation(lambda onsets, rho: {"reported": ssm.Binomial(onsets, rho)})
    return model


# -- results
def test_draws_of_a_step_are_nan_at_the_first_row_of_results():
    name, data = "counts", DATA["counts"]
    idata = ssm.sample(
        models.counts, data, ssm.PGAS(particles=5), draws=5, warmup=5, chains=1, seed=1,
        progress=False,
    )  # fmt: skip
    filtered = ssm.particle_filter(models.counts, data, SHARES, particles=20, seed=1, history=True)
    found = [
        ssm.simulate(models.counts, SHARES, steps=4, draws=2, seed=1)["leave"],
        filtered["leave"], filtered["leave_particles"], idata["posterior"]["leave"],
        ssm.smooth(models.counts, data, SHARES)["leave"],
        ssm.predict(models.counts, None, data, draws=3, seed=1)["prior"]["leave"],
    ]  # fmt: skip
    for values in found:
        first = values.isel(time=0).values
        assert np.isnan(first).all(), values
        assert np.isfinite(values.isel(time=slice(1, None)).values).all()
    ahead = ssm.forecast(models.counts, idata, 3, seed=1)
    assert np.isfinite(ahead["leave"].values).all()
    assert name in str(ssm.explain(models.counts))


def test_explain_tells_a_draw_of_the_step_from_a_state():
    text = str(ssm.explain(models.counts))
    before, _, after = text.partition("Transition, x_prev to x")
    assert "leave" not in before[before.index("Initial distribution") :]
    assert "auxiliary variable of the transition, undefined at t = 1" in after


def test_a_proposal_of_the_users_own():
    """It draws the states from the state before; a draw of the step may be left to its own law."""
    model = ssm.Model("own proposal")
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "z": ssm.Normal(0, sd=1)})
    model.transition(lambda: {"shock": ssm.Normal(0, sd=0.5)})
    model.transition(lambda x, shock_next: {"x": ssm.Normal(0.8 * x + shock_next, sd=0.5)})
    model.transition(lambda z, x_next: {"z": ssm.Dirac(0.5 * z + x_next)})
    model.observation(lambda z: {"y": ssm.Normal(z, sd=0.5)})
    data = {"y": np.array([0.3, -0.5, 1.0, 0.2])}
    exact = ssm.log_likelihood(model, data, {})[0]
    model.proposal(lambda x, z, y: {"x": ssm.Normal(0.4 * x + 0.5 * (y - 0.5 * z), sd=0.7)})
    found = ssm.log_likelihood(
        model, data, {}, proposal="user", particles=60, repeats=2000, seed=seed_of("own")
    )
    assert mean_one_p(found - exact) > LEVEL
