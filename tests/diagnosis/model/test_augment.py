"""Models with effects added: strength 0 gives the model back, others do what they say."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import ssmppl as ssm
from ssmppl.analysis.density import Missing
from ssmppl.analysis.score import CompleteScore
from ssmppl.codegen.modules.program import compile_trace
from ssmppl.diagnosis.effects.effect import Auxiliary, effect
from ssmppl.diagnosis.model.augment import augment
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.changed_laws import (
    NORMAL,
    heavier,
    noise_free,
    on_its_scale,
    scaled,
    shifted,
    values_on_its_scale,
)
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.diagnosis.model.score_columns import score_columns
from ssmppl.diagnosis.report.model_file import to_model
from ssmppl.errors import ArgumentError
from ssmppl.expressions.calculus import differentiate
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import constant, substitute, symbol, symbols_of
from ssmppl.language.tracing import trace
from tests.diagnosis.harness import EVERY, content, nodes, offered, scales, traced
from tests.models import gaps as models

LAWS = ("initial", "transition", "observations")


def strengths(candidates):
    """The symbols of the candidates' strengths."""
    return [symbol("parameter", c.strength) for c in candidates]


def at_zero(t, candidates):
    """The laws of the model's own quantities with all strengths 0, as (law, its expressions)."""
    zero = {s: constant(0.0) for s in strengths(candidates)}
    return {
        (role, n): (site.distribution, substitute(nodes(site.distribution), zero))
        for role in LAWS
        for n, site in getattr(t, role).items()
    }


def assert_gives_back(t, candidates):
    new = at_zero(augment(t, candidates), candidates)
    for role in LAWS:
        for n, site in getattr(t, role).items():
            law, found = new[role, n]
            if type(law) is not type(site.distribution) or "like_df" in law.parameters:
                assert "tail" in {c.change for c in candidates}, (n, law)
                continue
            kept = [constant(0.0) if e is constant(-0.0) else e for e in found]  # of a mean of 0
            assert list(map(id, kept)) == list(map(id, nodes(site.distribution))), (n, candidates)


@pytest.mark.parametrize("name", models.MODELS)
def test_strength_zero_gives_the_model_back(name):
    """Expression by expression, for every item of the catalogue (the first of each group)."""
    t = traced("gap", name)
    firsts = {c.group: c for c in reversed(offered("gap", name)[0])}
    for c in firsts.values():
        assert_gives_back(t, [c])


@pytest.mark.slow
@pytest.mark.parametrize(("where", "name"), EVERY)
def test_strength_zero_gives_every_model_back(where, name):
    """Every candidate of every test model, by itself and all together."""
    t = traced(where, name)
    found = offered(where, name)[0]
    for c in found:
        assert_gives_back(t, [c])
    assert_gives_back(t, found)


def test_students_t_stands_for_the_normal_law_at_strength_zero():
    """Its log density is off by `NORMAL` (e^4 - 2 e^2 - 1) / 4, whose factor is the score."""
    law = ssm.Normal(symbol("state", "x"), sd=2.0)
    s, y = symbol("parameter", "s"), symbol("observation", "y")
    tail = heavier(law, {(): s})
    density = tail.log_density(np.array(y))
    score = differentiate([density], s)[0]
    e = np.linspace(-4, 4, 17)
    at = {y: 1.0 + 2.0 * e, symbol("state", "x"): 1.0, s: 0.0}
    exact = (e**4 - 2 * e**2 - 1) / 4
    found = evaluate(density, at) - stats.norm.logpdf(e) + math.log(2.0)
    # second order in 1/df: moments of e up to the eighth, below 2e4 here
    np.testing.assert_allclose(found, NORMAL * exact, atol=2e4 * NORMAL**2)
    np.testing.assert_allclose(evaluate(score, at), exact, atol=4e4 * NORMAL)
    at[s] = 0.25 - NORMAL
    t_law = stats.t.logpdf(e, 4) - math.log(2.0)
    np.testing.assert_allclose(evaluate(density, at), t_law, atol=1e-9)


# -- what the changes of laws are
D = ssm
POINT = {symbol("parameter", "a"): 0.4, symbol("parameter", "p"): 0.3}
A, P = POINT


@pytest.mark.parametrize(
    ("law", "scale"),
    [
        (D.Normal(A, variance=2.0), "mean"), (D.StudentT(5, A, scale=1.0), "loc"),
        (D.Laplace(A, scale=1.0), "loc"), (D.Cauchy(A, scale=1.0), "loc"),
        (D.Dirac(A), "loc"), (D.LogNormal(A, sd=0.5), "log"), (D.Poisson(A), "log"),
        (D.NegativeBinomial(A, dispersion=2.0), "log"), (D.Gamma(A, rate=P), "log"),
        (D.Gamma(A, scale=P), "log"), (D.Exponential(rate=A), "log"),
        (D.Exponential(scale=A), "log"), (D.Bernoulli(P), "logit"), (D.Binomial(7, P), "logit"),
    ],
)  # fmt: skip
def test_increments_act_on_the_scale_that_is_said(law, scale):
    link = {"mean": lambda m: m, "loc": lambda m: m, "log": np.log,
            "logit": lambda m: np.log(m / (1 - m))}[scale]  # fmt: skip
    by = 0.37
    size = 7.0 if isinstance(law, D.Binomial) else 1.0
    before, after = (
        evaluate(noise_free(d, ()), POINT) / size for d in (law, shifted(law, {(): constant(by)}))
    )
    assert link(after) - link(before) == pytest.approx(by, rel=1e-12)


@pytest.mark.parametrize(
    ("law", "link"),
    [
        (D.Normal(A, sd=P), lambda m: m), (D.LogNormal(A, sd=P), lambda m: np.log(m)),
        (D.Poisson(A), np.log), (D.Gamma(A, rate=P), np.log), (D.Exponential(rate=A), np.log),
        (D.Bernoulli(P), lambda m: np.log(m / (1 - m))),
        (D.Binomial(7, P), lambda m: np.log(m / (7 - m))),
    ],
)  # fmt: skip
def test_effects_see_a_channel_on_the_scale_on_which_they_act(law, link):
    """So that a lag moves a count towards an earlier one, and clipping holds it where it clips: by
    an increment of the log, what lies above is taken off."""
    own = evaluate(on_its_scale(law, ()), POINT)
    assert own == pytest.approx(link(evaluate(noise_free(law, ()), POINT)), rel=1e-12)
    target = own - 0.4
    clipped = shifted(law, {(): constant(target) - on_its_scale(law, ())})
    assert evaluate(on_its_scale(clipped, ()), POINT) == pytest.approx(target, rel=1e-9)


def test_measured_values_on_that_scale():
    y = np.array([0.0, 4.0, np.nan, 10.0])
    np.testing.assert_allclose(values_on_its_scale(D.Poisson(A), y), np.log([2.0, 4.0, np.nan, 10]))
    np.testing.assert_array_equal(values_on_its_scale(D.Normal(A, sd=1.0), y), y)
    shares = values_on_its_scale(D.Bernoulli(P), np.array([0.0, 1.0, np.nan]))
    np.testing.assert_allclose(shares, [-np.log(3.0), np.log(3.0), np.nan])


@pytest.mark.parametrize(
    "law",
    [
        D.Normal(A, sd=P), D.Normal(A, variance=P), D.Normal(A, precision=P),
        D.StudentT(5, A, scale=P), D.Laplace(A, scale=P),
        D.Truncated(D.Normal(A, sd=P), lower=-60.0),
    ],
)  # fmt: skip
def test_log_variances_are_moved_as_said(law):
    before, after = (evaluate(d.variance(), POINT) for d in (law, scaled(law, {(): constant(0.8)})))
    np.testing.assert_allclose(np.log(after / before), 0.8, rtol=1e-9)


@pytest.mark.parametrize("spread", ["covariance", "precision", "cholesky"])
def test_the_variance_of_one_component_of_a_vector(spread):
    q = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, -0.2], [0.1, -0.2, 0.5]])
    given = {"covariance": q, "precision": np.linalg.inv(q), "cholesky": np.linalg.cholesky(q)}
    law = D.MvNormal(np.zeros(3), **{spread: given[spread]})
    new = scaled(law, {(1,): constant(0.8), (2,): constant(-0.5)})
    factor = np.diag(np.exp([0.0, 0.4, -0.25]))
    np.testing.assert_allclose(evaluate(new.covariance_matrix()), factor @ q @ factor, rtol=1e-12)


# -- whole models
def picked(where, name, *items):
    return [
        next(c for c in offered(where, name)[0] if (c.effect.name, c.equation) == i) for i in items
    ]


def means(t, values):
    """Numbers of the mean of every state's transition at numbers for its symbols."""
    roots = {n: s.distribution.mean()[()] for n, s in t.transition.items()}
    known = {s: values[s.data[1]] for e in roots.values() for s in symbols_of(e)}
    return {n: float(evaluate(e, known)) for n, e in roots.items()}


def test_effects_do_what_their_formulas_say():
    """Drag, friction, a stop of the position and a saturated input, worked out by hand."""
    t = traced("gap", "oscillator")
    found = picked(
        "gap",
        "oscillator",
        ("quadratic drag", "v"),
        ("coulomb friction", "v"),
        ("hard stop", "v"),
        ("input saturation", "u"),
        ("coarse discretisation", "x"),
    )
    shape = {c.effect.name: dict(c.shape) for c in found}
    at = {"x": 5.0, "v": -1.2, "u": 9.0, "k": 1.1, "c": 0.3, "b": 2.0}
    lam = {c.strength: 0.1 * (i + 1) for i, c in enumerate(found)}
    got = means(augment(t, found), at | lam)
    x, v, u, k, c, b = at.values()
    drag, friction, stop, saturated, coarse = lam.values()
    limit = shape["input saturation"]["c"]
    acting = u - saturated * (u - np.clip(u, -limit, limit))
    step = 0.1 * (-k * x - c * v + b * acting)
    added = -drag * v * abs(v) - friction * np.tanh(v / shape["coulomb friction"]["v0"])
    added -= stop * max(x - shape["hard stop"]["h"], 0.0)
    assert got["v"] == pytest.approx(v + step + added, rel=1e-12)
    assert got["x"] == pytest.approx(x + 0.1 * v + coarse * 0.5 * 0.1 * step, rel=1e-12)


def counts():
    """A level, and counts of which it is the logarithm of the mean."""
    model = ssm.Model("counts")
    model.prior(lambda: {"q": ssm.Gamma(2, rate=1)})
    model.initial(lambda: {"x": ssm.Normal(4, sd=1)})
    model.transition(lambda x, q: {"x": ssm.Normal(x, variance=q)})
    model.observation(lambda x: {"y": ssm.Poisson(np.exp(x))})
    return trace(model)


def test_effects_on_counts_act_on_the_logarithm_and_see_it():
    """A lag of strength 1 gives the mean that was, and full clipping the count where it begins: a
    lag of the mean itself, added to its logarithm, gained an epidemic 5 nats of 39."""
    t = counts()
    y = np.exp(np.linspace(2.0, 6.0, 50))
    own = Scales.of(t, np.log(y)[:, None], y[:, None], np.zeros((50, 0)), 50)
    assert own.scale["y"].mean == pytest.approx(4.0, abs=1e-9)
    found = {(c.effect.name, c.effect.form): c for c in offers(t, own)[0] if c.equation == "y"}
    lag, clip = found["sensor lag", ""], found["sensor clipping", "upper"]
    assert 2.0 < dict(clip.shape)["c"] < 6.0
    rate = {}
    for c in (lag, clip):
        augmented = augment(t, [c])
        law = augmented.observations["y"].distribution
        values = dict.fromkeys(symbols_of([law.parameters["rate"][()]]), 1.0)
        values |= {symbol("state", "x"): 5.9, symbol("parameter", c.strength): 1.0}
        values |= {s: 3.0 for s in augmented.state_symbols if s.data[1] != "x"}
        rate[c.effect.name] = float(evaluate(law.parameters["rate"][()], values))
    assert rate["sensor lag"] == pytest.approx(np.exp(3.0))
    assert rate["sensor clipping"] == pytest.approx(np.exp(dict(clip.shape)["c"]))


def test_quantisation_rounds():
    c = next(c for c in offered("gap", "ar1")[0] if c.effect.name == "quantisation")
    d = dict(c.shape)["d"]
    law = augment(traced("gap", "ar1"), [c]).observations["y"].distribution
    x = np.linspace(-3.3, 3.1, 101)
    at = {symbol("state", "x"): x, symbol("parameter", c.strength): 1.0}
    np.testing.assert_allclose(evaluate(law.mean(), at), d * np.round(x / d), atol=1e-12)


def test_an_overflow_goes_into_the_other_tank():
    (over,) = [c for c in offered("gap", "two_tanks")[0]
               if c.effect.form.startswith("overflow") and c.equation == "h1"]  # fmt: skip
    t = traced("gap", "two_tanks")
    at = {"h1": 9.0, "h2": 4.0, "pump": 1.0, "k1": 0.1, "k2": 0.1, "b": 0.1}
    base, new = means(t, at), means(augment(t, [over]), at | {over.strength: 0.3})
    excess = 0.3 * (9.0 - dict(over.shape)["h"])
    assert new["h1"] - base["h1"] == pytest.approx(-excess)
    assert new["h2"] - base["h2"] == pytest.approx(excess)


def simulated_by(model, name, parameters, steps=40, seed=1):
    inputs = models.inputs_of(name, steps) or None
    return ssm.simulate(model, parameters, steps=steps, inputs=inputs, seed=seed)


@pytest.mark.slow
def test_memory_works_as_it_is_described():
    """Delay, lag and play of the input, delay of the sensor: against loops over the rows."""
    wanted = ("input delay", "actuator lag", "backlash", "sensor delay")
    items = [c for c in offered("gap", "simulator")[0] if c.effect.name in wanted]
    u = models.inputs_of("simulator", 40)["u"]
    theta = models.THETA["simulator"]
    for c in items:
        shape = dict(c.shape)
        first = shape.get("before", 1.0) * u[0]
        acting, play, lag = u.copy(), u[0], first
        for t in range(40):
            if c.effect.name == "input delay":
                delay = int(shape["delay"])
                acting[t] = u[t - delay] if t >= delay else first
            elif c.effect.name == "actuator lag":
                lag += (u[t] - lag) / shape["k"]
                acting[t] = lag
            elif c.effect.name == "backlash":
                play = min(max(play, u[t] - shape["c"]), u[t] + shape["c"])
                acting[t] = play
        x, v, path = 0.2, 0.0, []
        for t in range(40):
            path.append(x)
            x, v = x + 0.1 * v, v + 0.1 * (acting[t] - theta["k"] * x - theta["c"] * v)
        model = to_model(augment(traced("gap", "simulator"), [c]))
        drawn = simulated_by(model, "simulator", theta | {c.strength: 1.0})
        np.testing.assert_allclose(drawn["x"].values[0], path, atol=1e-12)
        if c.effect.name == "sensor delay":
            late = [shape["start"]] * int(shape["delay"]) + path
            noise = drawn["y"].values[0] - late[:40]
            assert np.max(np.abs(noise)) < 6 * theta["r"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["oscillator", "epidemic"])
def test_the_compiled_model_simulates_as_the_base_at_strength_zero(name):
    """With every item of the catalogue that needs no further random numbers, at once."""
    t = traced("gap", name)
    firsts = {c.group: c for c in reversed(offered("gap", name)[0])}
    found = [c for c in firsts.values() if c.first_order and c.change != "tail"]
    model = to_model(augment(t, found))
    theta = models.THETA[name]
    least = 1e-14  # HalfFlat begins above 0
    new = simulated_by(model, name, theta | {c.strength: least for c in found})
    base = simulated_by(models.build(name), name, theta)
    for n in [*t.initial, *t.observations]:
        np.testing.assert_allclose(new[n], base[n], rtol=1e-9, atol=1e-9)


def test_augmented_traces_compile():
    t = traced("gap", "ar1")
    found = picked("gap", "ar1", ("quadratic drag", "x"), ("sensor lag", "y"), ("outliers", "y"),
                   ("parameter random walk", "phi"))  # fmt: skip
    program = compile_trace(augment(t, found), Missing(none=True))
    for c in found:
        assert c.strength in program.source()


def test_strengths_have_scores_in_closed_form():
    """The score of every first-order candidate is derived without an obstacle, all at once.

    Also where states are deterministic, so that what one effect does moves what others depend on.
    """
    for name in ("oscillator", "epidemic", "simulator"):
        t = traced("gap", name)
        found = [c for c in offered("gap", name)[0] if c.first_order]
        score = CompleteScore(augment(t, found), strengths(found), Missing(none=True))
        for s in strengths(found):
            assert score.obstacle(s) is None, (s, score.obstacle(s))


def test_parameters_of_an_exponential_have_scores():
    """A linear equation is solved over a row by an exponential, whose halvings jump and whose
    values do not: nothing of it is refused."""

    def step(x, v, u, inertia, c):
        def rhs(x, v):
            return {"x": v, "v": (u - c * v) / inertia}

        new = ssm.integrate(rhs, {"x": x, "v": v}, 0.01)
        return {"x": ssm.Dirac(new["x"]), "v": ssm.Normal(new["v"], sd=0.1)}

    model = ssm.Model("motor", inputs=("u",))
    model.prior(lambda: {"inertia": ssm.HalfNormal(sd=1), "c": ssm.HalfNormal(sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "v": ssm.Normal(0, sd=1)})
    model.transition(step)
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    t = trace(model)
    found = [c for c in offers(t, scales(t))[0] if c.first_order]
    columns = score_columns(t, augment(t, found), {c.strength for c in found}, (),
                            Missing(none=True))  # fmt: skip
    assert columns.refused == {}
    assert {s.data[1] for s in columns.nuisance} == {"inertia", "c"}
    assert any(n.startswith("parameter_drift_inertia") for n in columns.names)


# -- several together, names, priors
def test_effects_on_one_equation_add_up():
    t = traced("gap", "oscillator")
    inputs = [c for c in offered("gap", "oscillator")[0] if c.change == "input"][:6]
    at = {"x": 1.0, "v": 0.5, "u": 2.5, "k": 1.0, "c": 0.2, "b": 0.7}
    base = means(t, at)["v"]
    alone = [means(augment(t, [c]), at | {c.strength: 0.3})["v"] - base for c in inputs]
    together = means(augment(t, inputs), at | {c.strength: 0.3 for c in inputs})["v"] - base
    assert together == pytest.approx(sum(alone), rel=1e-9)


def test_equal_auxiliary_states_are_shared():
    t = traced("gap", "oscillator")
    lags = [c for c in offered("gap", "oscillator")[0] if c.effect.name == "actuator lag"]
    lags = [c for c in lags if dict(c.shape)["before"] == 1.0]
    twin = replace(lags[0], strength="twin")
    new = augment(t, [*lags, twin])
    assert [n for n in new.initial if n not in t.initial] == [
        "lagged_u",
        "lagged_u_2",
        "lagged_u_3",
    ]


def test_priors_follow_the_bounds():
    t = traced("gap", "oscillator")
    found = picked("gap", "oscillator", ("quadratic drag", "v"), ("constant load", "v"),
                   ("actuator lag", "u"))  # fmt: skip
    laws = {n: type(s.distribution).__name__ for n, s in augment(t, found).parameters.items()}
    assert [laws[c.strength] for c in found] == ["HalfFlat", "Flat", "Uniform"]
    assert list(augment(t, found, prior=False).parameters) == list(t.parameters)


def test_a_held_process_is_a_constant_increment():
    t = traced("gap", "oscillator")
    found = offered("gap", "oscillator")[0]
    load = next(c for c in found if c.effect.name == "constant load")
    constant_law = augment(t, [load]).transition["v"].distribution
    for c in found:
        if c.increment.key == load.key:
            held = replace(c.increment, strength=load.strength)
            new = augment(t, [held])
            assert list(new.initial) == list(t.initial)
            assert content(new.transition["v"].distribution) == content(constant_law)


def test_what_does_not_fit_is_refused():
    t = traced("gap", "oscillator")
    c = picked("gap", "oscillator", ("quadratic drag", "v"))[0]
    with pytest.raises(ArgumentError, match="is named 'k', as is the model's parameter"):
        augment(t, [replace(c, strength="k")])
    with pytest.raises(ArgumentError, match="as is the strength of"):
        augment(t, [c, c])
    with pytest.raises(ArgumentError, match="has no 'speed'"):
        augment(t, [replace(c, equation="speed")])
    with pytest.raises(ArgumentError, match="cannot be added: its distribution is"):
        augment(traced("features", "simplex"), [replace(c, equation="p[0]")])


def test_users_effects_of_every_kind():
    """Each kind by a function of the user's, with the model's own quantities as arguments."""

    @effect(on="v", kind="transition")
    def wind(v, u, k, t, strength):
        return strength * u * k * t

    @effect(on="y", kind="observation")
    def parallax(h, v, strength):
        return strength * h * v

    @effect(on="u", kind="input")
    def gain(u, x, strength):
        return u * (1.0 + strength * x)

    @effect(on="y", kind="noise")
    def shaky(h, v, strength):
        return strength * v**2

    @effect(on="y", kind="tail", lower=0, upper=0.4)
    def spikes(h, strength):
        return strength

    @effect(on="c", kind="parameter")
    def warming(c, t, strength):
        return c * np.exp(strength * t)

    @effect(on="x", kind="initial")
    def start(x, strength):
        return strength

    @effect(on="rate", kind="state", states=("w",), shapes={"rate": (0.1, 0.5)})
    def creep(v, w, x, strength, rate):
        return Auxiliary(strength * w, {"w": ssm.Normal(w + rate * (x - w), sd=0.1)},
                         {"w": ssm.Normal(0, sd=1)})  # fmt: skip

    mine = [wind, parallax, gain, shaky, spikes, warming, start, creep]
    t = traced("gap", "oscillator")
    found, refused = offers(t, scales(t), {e.name: e for e in mine})
    assert [c.effect.name for c in found if c.effect.name != "creep"] == [e.name for e in mine[:-1]]
    rates = [dict(c.shape)["rate"] for c in found if c.effect.name == "creep"]
    assert rates == [0.1, 0.5]
    assert [r.equation for r in refused] == ["x"]
    for c in found:
        assert_gives_back(t, [c])
    model = to_model(augment(t, found))
    assert {*trace(model).parameters} == {*t.parameters, *(c.strength for c in found)}


def test_pairs_are_independent_of_their_order():
    t = traced("gap", "ar1")
    found = picked("gap", "ar1", ("quadratic drag", "x"), ("sensor bias", "y"), ("outliers", "y"),
                   ("heteroscedastic noise", "y"))  # fmt: skip
    for a, b in itertools.combinations(found, 2):
        one, other = augment(t, [a, b]), augment(t, [b, a])
        for role in LAWS:
            for n, site in getattr(one, role).items():
                assert content(site.distribution) == content(getattr(other, role)[n].distribution)
