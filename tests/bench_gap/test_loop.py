"""The practitioner's loop: its columns against formulas by hand, what it adds, where it stops."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import ssmppl as ssm
from bench.gap import loop, records, rivals
from bench.gap.disturbances import Disturbances
from bench.gap.loop import Loop, _inside, told
from ssmppl.errors import SamplingError
from tests.statistics.checks import seed_of

DT, ROWS = 0.1, 300
TRUE = {"k": 2.0, "c": 0.6, "q": 0.05, "r": 0.02}


def cart():
    """A cart on a spring: linear and Gaussian."""
    model = ssm.Model("cart", inputs=("u",))
    model.prior(lambda: {n: ssm.LogNormal(np.log(v), sd=1.0) for n, v in TRUE.items()})
    model.initial(lambda: {"x": ssm.Normal(0.0, sd=0.5), "v": ssm.Normal(0.0, sd=0.5)})
    model.transition(lambda x, v, u, k, c, q: {
        "x": ssm.Dirac(x + DT * v), "v": ssm.Normal(v + DT * (u - k * x - c * v), sd=q),
    })  # fmt: skip
    model.observation(lambda x, r: {"y": ssm.Normal(x, sd=r)})
    return model


def driven(name, added=lambda x, v, u, t: 0.0, wild=1.0):
    """Rows of a cart with what is added to each step of v; every 25th reading is `wild`."""
    rng = np.random.default_rng(seed_of("loop", name))
    t = np.arange(ROWS)
    u = np.sin(0.21 * t) + 0.7 * np.sin(0.083 * t + 1.0) + 0.3 * rng.standard_normal(ROWS)
    x = v = 0.0
    y = np.empty(ROWS)
    for i in range(ROWS):
        y[i] = x + TRUE["r"] * rng.standard_normal() * (wild if i % 25 == 7 else 1.0)
        push = DT * (u[i] - TRUE["k"] * x - TRUE["c"] * v) + added(x, v, u, i)
        x, v = x + DT * v, v + push + TRUE["q"] * rng.standard_normal()
    return {"y": y, "u": u}


@pytest.fixture(scope="module")
def seen():
    """(the disturbances at the true parameters, the candidates)"""
    made = Loop(cart(), driven("plain"))
    fitter = made.augmented.base_fitter
    fit = fitter.fit(made.experiments, made.seed, {k: np.asarray(v) for k, v in TRUE.items()})
    return Disturbances(fitter, fit, made.e), made._offered(fitter, fit)


def one(candidates, effect, equation, **shape):
    found = [c for c in candidates if (c.effect.name, c.equation) == (effect, equation)]
    close = [c for c in found if all(dict(c.shape)[n] == v for n, v in shape.items())]
    return close[0]


def test_disturbances_are_what_the_equations_leave(seen):
    d, _ = seen
    k, c = (d.fit.by_component[n] for n in ("k", "c"))
    (x, v), (u, y) = d.x.T, (d.e.u[:, 0], d.e.y[:, 0])
    step = v[1:] - v[:-1] - DT * (u[:-1] - k * x[:-1] - c * v[:-1])
    assert np.all(np.abs(np.diff(x) - DT * v[:-1]) < 1e-9)  # it moves as it has to
    for part, left, first in (("v", step, 1), ("y", y - x, 0)):
        own = d.part == part
        np.testing.assert_allclose(d.values[own], left / np.sqrt(np.mean(left**2)), atol=1e-9)
        np.testing.assert_array_equal(d.row[own], np.arange(first, ROWS))
        np.testing.assert_allclose(d.unit[own], np.sqrt(np.mean(left**2)))
    assert set(d.part) == {"v", "y"}


def by_hand():
    """(effect, equation, shape, part, column) from the states, the input and the row."""

    def shifted(u, n):
        return np.concatenate([np.full(n, u[0]), u[:-n]])

    def followed(u, k):
        w = np.full(len(u), u[0])
        for t in range(1, len(u)):
            w[t] = w[t - 1] + (u[t - 1] - w[t - 1]) / k
        return w + (u - w) / k

    return [
        ("quadratic drag", "v", {}, "v", lambda x, v, u, t: -v * np.abs(v)),
        ("cubic stiffness", "v", {}, "v", lambda x, v, u, t: -(x**3)),
        ("constant load", "v", {}, "v", lambda x, v, u, t: np.ones(len(x))),
        ("input delay", "u", {"delay": 2}, "v", lambda x, v, u, t: DT * (shifted(u, 2) - u)),
        ("actuator lag", "u", {"k": 5}, "v", lambda x, v, u, t: DT * (followed(u, 5) - u)),
        ("parameter drift", "k", {}, "v", lambda x, v, u, t: -DT * x),  # of its logarithm, at 1
        ("sensor bias", "y", {}, "y", lambda x, v, u, t: np.ones(len(x))),
    ]


@pytest.mark.parametrize("case", by_hand(), ids=lambda case: case[0])
def test_columns_are_what_the_effects_add(seen, case):
    d, candidates = seen
    effect, equation, shape, part, formula = case
    found = d.column(one(candidates, effect, equation, **shape))
    expected = formula(*d.x.T, d.e.u[:, 0], np.arange(ROWS))
    if effect == "parameter drift":
        expected = d.fit.by_component["k"] * expected
    expected = expected[:-1] if part == "v" else expected
    own = d.part == part
    np.testing.assert_allclose(found[own] * d.unit[own], expected, rtol=1e-6, atol=1e-12)
    assert np.all(found[~own] == 0.0)


def test_the_statistic_is_a_partial_correlation(seen):
    """Of what a term leaves once the model's own ones have explained what they can."""
    d, candidates = seen
    c = one(candidates, "cubic stiffness", "v")
    x, v = d.x[:-1].T
    own = d.part == "v"
    g = -(x**3)
    g = g - np.stack([x, v], 1) @ np.linalg.lstsq(np.stack([x, v], 1), g, rcond=None)[0]
    z = g @ d.values[own] / np.sqrt(g @ g)
    column = d.column(c)
    assert d.statistic(c, column) == pytest.approx(z, rel=1e-6)
    strength = g @ (d.values[own] * d.unit[own]) / (g @ g)
    assert d.strength(c, column) == pytest.approx(strength, rel=1e-6)
    stiffness = d.column(one(candidates, "parameter drift", "k"))  # without its function of time
    drag = one(candidates, "quadratic drag", "v")
    assert d.statistic(drag, stiffness) == d.statistic(drag, -stiffness) == 0.0


def test_functions_of_time_weigh_the_rows(seen):
    d, candidates = seen
    date = 120.0
    dated = [c for c in candidates if c.effect.name == "parameter break" and c.equation == "c"]
    c = min(dated, key=lambda c: abs(dict(c.shape)["date"] - date))
    date = dict(c.shape)["date"]
    own, t = d.part == "v", np.arange(1, ROWS)  # counted from one, of the row before
    g = np.where(t >= date, d.x[:-1, 1], 0.0)
    mine = np.stack([*d.x[:-1].T], 1)
    g = g - mine @ np.linalg.lstsq(mine, g, rcond=None)[0]
    z = abs(g @ d.values[own]) / np.sqrt(g @ g)
    assert abs(d.statistic(c, d.column(c))) == pytest.approx(z, rel=1e-6)


def test_a_jump_is_in_the_step_that_follows_its_date(seen):
    d, candidates = seen
    jumps = [c for c in candidates if (c.effect.name, c.equation) == ("level break", "v")]
    c = next(c for c in jumps if dict(c.shape)["date"] == 100.0)
    own = (d.part == "v") & (d.row == 100)  # from the hundredth row to the next, which is 100 here
    g = d._alone(np.where(own, 1.0, 0.0))
    z = g @ d.values / np.sqrt(g @ g)
    assert d.statistic(c, d.column(c)) == pytest.approx(z, rel=1e-6)


def test_a_sign_that_an_effect_cannot_have_counts_for_nothing(seen):
    d, candidates = seen
    c = one(candidates, "quadratic drag", "v")
    column = d.column(c)
    both = d.statistic(c, column), d.statistic(c, -column)
    assert min(both) == 0.0 < max(both)


def test_corrections_are_those_of_the_filter(seen):
    d, _ = seen
    exact = d.fitter.kalman.filter(d.e, d.fit.theta)
    left = d.e.y[:, 0] - exact.observation_mean[:, 0]
    moved = (exact.mean - exact.mean_predicted)[1:, 1]
    for part, expected in (("y", left), ("v", moved)):
        expected = expected / np.sqrt(np.mean(expected**2))
        np.testing.assert_allclose(d.corrections[d.part == part], expected, atol=1e-9)


def test_what_remembers_is_held_against_the_filters_errors(seen):
    """AR(1) errors of the filter: as often as not the past has their sign."""
    d, candidates = seen
    c = one(candidates, "coloured noise", "y", memory=0.9)
    column = d.column(c)
    plain = d.statistic(c, column)
    rng, own = np.random.default_rng(seed_of("remembers")), d.part == "y"
    colour = np.zeros(ROWS)
    for t in range(1, ROWS):
        colour[t] = 0.9 * colour[t - 1] + rng.standard_normal()
    was = d.corrections.copy()
    try:
        d.corrections[own] = colour / np.sqrt(np.mean(colour**2))
        past = np.zeros(ROWS)
        for t in range(1, ROWS):
            past[t] = 0.9 * (past[t - 1] + d.corrections[own][t - 1])
        r = past @ d.corrections[own] / np.sqrt((past @ past) * ROWS)
        assert d.statistic(c, column) == pytest.approx(r * np.sqrt(ROWS), rel=1e-6)
        assert d.statistic(c, column) > plain + 5.0
        d.corrections[own] *= (-1.0) ** np.arange(ROWS)
        assert d.statistic(c, column) == 0.0  # what turns every time remembers nothing
    finally:
        d.corrections[:] = was


def test_laws_of_the_noise_go_by_squares_and_fourth_powers(seen):
    d, candidates = seen
    own = d.part == "y"
    w = d.values[own]
    was = w.copy()
    tail = one(candidates, "outliers", "y")
    try:
        for odd in (1.0, 6.0):
            d.values[own] = np.where(np.arange(ROWS) % 25 == 7, odd, 1.0) * was
            w = d.values[own] / np.sqrt(np.mean(d.values[own] ** 2))
            d.values[own] = w
            z = np.sqrt(ROWS / 24.0) * (np.mean(w**4) - 3.0)
            assert d.statistic(tail, d.column(tail)) == pytest.approx(max(z, 0.0), abs=1e-6)
        assert z > 10.0
    finally:
        d.values[own] = was
    grows = one(candidates, "heteroscedastic noise", "y")
    assert grows.form == "with its own size"
    column = d.column(grows)
    np.testing.assert_allclose(column[own] * dict(grows.shape)["s"], np.abs(d.x[:, 0]), rtol=1e-9)
    r = np.corrcoef(column[own], was**2)[0, 1]
    assert d.statistic(grows, column) == pytest.approx(r * np.sqrt(ROWS), rel=1e-6)
    slope = np.polyfit(column[own], was**2 - 1.0, 1)[0]  # of the log variance, near one
    assert d.strength(grows, column) == pytest.approx(slope, rel=1e-6)


def test_what_remembers_begins_with_half_of_the_disturbances(seen):
    d, candidates = seen
    unit = d.unit[d.part == "v"][0]
    for form, share in (("ar1", 0.5), ("random walk", 0.1)):
        c = next(c for c in candidates if c.effect.name == "missing input" and form in c.form)
        assert d.strength(c, d.column(c)) == pytest.approx(share * unit)


def test_a_wave_gets_the_period_that_fits_best(seen):
    d, candidates = seen
    waves = [c for c in candidates if c.effect.name == "periodic forcing"]
    off = min(waves, key=lambda c: abs(dict(c.shape)["period"] - 20.0))
    own, was = d.part == "v", d.values.copy()
    try:
        d.values[own] = np.cos(2.0 * np.pi / 20.3 * np.arange(1, ROWS) - 1.1)
        shape = dict(d.refined(off, d.column(off)).shape)
    finally:
        d.values[:] = was
    assert shape["period"] == pytest.approx(20.3, rel=0.01)
    assert shape["phase"] == pytest.approx(1.1, abs=0.3)
    assert d.refined(one(candidates, "quadratic drag", "v"), off) == one(
        candidates, "quadratic drag", "v"
    )


# -- the loop
def test_nothing_is_added_to_a_right_model():
    verdict, ranked, count = Loop(cart(), driven("none")).run()
    assert (verdict, count) == ("no measurable gap", 0)
    assert len(ranked) > 10
    assert all(math.isnan(r.gain) for r in ranked)


@pytest.mark.slow
def test_effects_are_added_one_after_the_other():
    def added(x, v, u, t):
        return 0.1 * np.cos(2.0 * np.pi * t / 17.3) - 0.12 * np.tanh(v / 0.05)

    verdict, ranked, count = Loop(cart(), driven("two", added)).run()
    assert verdict == "effect"
    assert count >= 2
    labels = [(r.effect, r.equation) for r in ranked[:2]]
    assert ("periodic forcing", "v") in labels
    assert labels[0] != labels[1]
    assert {e for e, _ in labels} & {"coulomb friction", "bouc-wen hysteresis"}
    assert all(r.gain > 10.0 for r in ranked[:2])
    assert len({(r.effect, r.equation) for r in ranked}) == len(ranked)


@pytest.mark.slow
def test_wild_readings_are_outliers():
    verdict, ranked, _ = Loop(cart(), driven("wild", wild=8.0)).run()
    assert verdict == "effect"
    assert (ranked[0].effect, ranked[0].equation) == ("outliers", "y")


@pytest.mark.slow
def test_a_model_of_small_steps_goes_through_the_loop():
    model = ssm.Model("a pendulum in small steps", inputs=("u",))

    def swung(a, w, u, g, c):
        rates = lambda s: np.stack([s[1], u - g * np.sin(s[0]) - c * s[1]])  # noqa: E731
        return ssm.integrate(rates, np.stack([a, w]), 0.1, steps=2)

    def step(a, w, u, g, c, q):
        new = swung(a, w, u, g, c)
        return {"a": ssm.Dirac(new[0]), "w": ssm.Normal(new[1], sd=q)}

    model.prior(lambda: {
        "g": ssm.LogNormal(np.log(8.0), sd=1.0), "c": ssm.LogNormal(np.log(0.5), sd=1.0),
        "q": ssm.LogNormal(np.log(0.03), sd=1.0), "r": ssm.LogNormal(np.log(0.01), sd=1.0),
    })  # fmt: skip
    model.initial(lambda: {"a": ssm.Normal(0.0, sd=0.5), "w": ssm.Normal(0.0, sd=0.5)})
    model.transition(step)
    model.observation(lambda a, r: {"y": ssm.Normal(a, sd=r)})
    rng = np.random.default_rng(seed_of("small steps"))
    t = np.arange(ROWS)
    u = 3.0 * np.sin(0.21 * t) + 2.0 * np.sin(0.083 * t + 1.0) + rng.standard_normal(ROWS)
    for load in (0.0, 0.15):
        a = w = 0.0
        y = np.empty(ROWS)
        for i in range(ROWS):
            y[i] = a + 0.01 * rng.standard_normal()
            a, w = np.asarray(swung(a, w, u[i], 10.0, 0.4), dtype=float)
            w += load + 0.02 * rng.standard_normal()
        verdict, ranked, _ = Loop(model, {"y": y, "u": u}).run()
        assert verdict == ("effect" if load else "no measurable gap")
        if load:
            assert (ranked[0].effect, ranked[0].equation) in [
                ("constant load", "w"), ("input asymmetry", "u")
            ]  # fmt: skip


@pytest.mark.parametrize("beyond", [-0.01, 0.01])
@pytest.mark.parametrize(
    ("name", "numbers"), [("periodic forcing", 3), ("constant load", 1), ("parameter break", 2)]
)
def test_an_effect_has_to_pay_for_its_strength_and_its_shapes(name, numbers, beyond, monkeypatch):
    """Half of log T each: a wave's period and phase are two, a break's date is one."""
    made = Loop(cart(), driven("none"))

    def found(self, added, seen, leading):
        if added:
            return None
        c = next(c for c, _ in leading if c.effect.name == name)
        gained = 0.5 * numbers * math.log(ROWS) + beyond
        fit = replace(seen.fit, log_likelihood=seen.fit.log_likelihood + gained)
        return c, self.augmented.base_fitter, fit

    monkeypatch.setattr(Loop, "_refitted", found)
    verdict, ranked, count = made.run()
    assert (verdict, count) == (("effect", 1) if beyond > 0.0 else ("no measurable gap", 0))
    if beyond > 0.0:
        assert ranked[0].effect == name
        assert ranked[0].gain == pytest.approx(beyond, abs=1e-6)


def test_at_most_three_are_added_each_with_another_form(monkeypatch):
    names = []

    def found(self, added, seen, leading):
        c = leading[0][0]
        names.append((c.group, [a.group for a in added]))
        fit = replace(seen.fit, log_likelihood=seen.fit.log_likelihood + 100.0)
        return c, self.augmented.base_fitter, fit

    monkeypatch.setattr(Loop, "_refitted", found)
    Loop(cart(), driven("none")).run()
    groups = [group for group, _ in names]
    assert len(set(groups)) == 3
    assert [added for _, added in names] == [groups[:0], groups[:1], groups[:2]]


def test_without_states_what_was_added_stands(monkeypatch):
    plain, calls = loop.Disturbances, []

    def known(fitter, fit, e):
        calls.append(fit)
        if len(calls) > lasting:
            raise ValueError("the likeliest states are not known")
        return plain(fitter, fit, e)

    def found(self, added, seen, leading):
        fit = replace(seen.fit, log_likelihood=seen.fit.log_likelihood + 100.0)
        return leading[0][0], self.augmented.base_fitter, fit

    monkeypatch.setattr(loop, "Disturbances", known)
    monkeypatch.setattr(Loop, "_refitted", found)
    lasting = 2  # for the scales, and for the first effect
    verdict, _, count = Loop(cart(), driven("none")).run()
    assert (verdict, count) == ("effect", 1)
    calls.clear()
    lasting = 1
    with pytest.raises(ValueError, match="not known"):
        Loop(cart(), driven("none")).run()


def test_a_refit_that_fails_leaves_the_effect_out(monkeypatch):
    made = Loop(cart(), driven("none"))
    fitter = made.augmented.base_fitter
    fit = made._climbed(fitter, {}, loop.FROM_START)
    d = Disturbances(fitter, fit, made.e)
    leading = made._leading(d, made._offered(fitter, fit))
    plain, bad = made.augmented.fitter, leading[0][0].strength

    def fitters(candidates):
        if candidates[-1].strength == bad:
            raise SamplingError("nothing can be fitted", fix="do not")
        return plain(candidates)

    monkeypatch.setattr(made.augmented, "fitter", fitters)
    c, _, new = made._refitted([], d, leading)
    assert c.strength == leading[1][0].strength
    assert new.log_likelihood > fit.log_likelihood
    assert made._refitted([], d, leading[:1]) is None


def test_a_refit_begins_inside_of_the_bounds(seen):
    _, candidates = seen
    drag, delay = one(candidates, "quadratic drag", "v"), one(candidates, "input delay", "u")
    load = one(candidates, "constant load", "v")
    assert 0.0 < _inside(drag, -3.0) < 1e-9
    assert _inside(drag, 2.0) == 2.0
    assert [_inside(delay, s) for s in (-1.0, 0.7, 9.0)] == pytest.approx([0.0625, 0.7, 1.1875])
    assert _inside(load, -3.0) == -3.0


def test_a_refit_begins_with_the_likeliest_share_of_the_strength(seen, monkeypatch):
    made = Loop(cart(), driven("plain"))
    d, candidates = seen
    c = one(candidates, "constant load", "v")
    begun = []

    def climbed(self, fitter, start, effort):
        begun.append(start)
        return d.fit

    monkeypatch.setattr(Loop, "_climbed", climbed)
    monkeypatch.setattr(Disturbances, "strength", lambda self, c, column: 0.8)
    likeliest = []
    monkeypatch.setattr(
        Loop, "_value", lambda self, fitter, at: -abs(float(at[c.strength]) - likeliest[-1])
    )
    for strength in (0.8, 0.4, 0.2):
        likeliest.append(strength)
        made._refitted([], d, [(c, d.column(c))])
        assert begun[-1][c.strength] == strength
    assert begun[-1]["k"] == d.fit.by_parameter["k"]  # and where the model was


def test_a_wave_is_fitted_with_its_own_period(seen, monkeypatch):
    made, (d, candidates) = Loop(cart(), driven("plain")), seen
    wave = one(candidates, "periodic forcing", "v")
    monkeypatch.setattr(
        Disturbances, "refined", lambda self, c, column: c.with_shape(period=11.0, phase=0.5)
    )
    c, fitter, fit = made._refitted([], d, [(wave, d.column(wave))])
    assert dict(c.shape) == {"period": 11.0, "phase": 0.5}
    assert fit.by_component[f"{c.strength}_period"] == 11.0
    assert fitter is not made.augmented.base_fitter


def test_the_others_stand_in_the_order_of_the_first_correlations(monkeypatch):
    plain, orders = Loop._leading, []

    def leading(self, seen, candidates):
        found = plain(self, seen, candidates)[:: -1 if orders else 1]
        orders.append([(c.effect.name, c.equation) for c, _ in found])
        return found

    def found(self, added, seen, leading):
        if added:
            return None
        fit = replace(seen.fit, log_likelihood=seen.fit.log_likelihood + 100.0)
        return leading[2][0], self.augmented.base_fitter, fit

    monkeypatch.setattr(Loop, "_leading", leading)
    monkeypatch.setattr(Loop, "_refitted", found)
    _, ranked, _ = Loop(cart(), driven("none")).run()
    first = list(dict.fromkeys([orders[0][2], *orders[0]]))
    assert [(r.effect, r.equation) for r in ranked] == first


def test_a_fit_that_is_not_at_its_top_is_taken_up_again():
    made, calls = Loop(cart(), driven("plain")), []

    class Slow:
        problem, fixed = made.augmented.base_fitter.problem, {}

        def fit(self, experiments, seed, start, effort):
            calls.append(dict(start))
            values = {"log_likelihood": float(len(calls)), "by_parameter": {"k": len(calls)}}
            return SimpleNamespace(**values, converged=len(calls) == 2)

    found = made._climbed(Slow(), {"k": 0.5, "of another model": 1.0}, loop.FROM_START)
    assert calls == [{"k": 0.5}, {"k": 1}]
    assert found.log_likelihood == 2.0


# -- as a rival
def test_what_is_told_has_the_added_ones_first(seen):
    _, candidates = seen
    drag = one(candidates, "quadratic drag", "v")
    load = one(candidates, "constant load", "v")
    verdict, ranked, count = told([(load, 7.0), (drag, 2.0)], [drag, drag, load])
    assert (verdict, count) == ("effect", 2)
    assert [(r.effect, r.gain) for r in ranked] == [("constant load", 7.0), ("quadratic drag", 2.0)]
    verdict, ranked, count = told([], [drag, load])
    assert (verdict, count, [r.effect for r in ranked]) == (
        "no measurable gap", 0, ["quadratic drag", "constant load"]
    )  # fmt: skip


def test_its_record_names_all_that_was_added_and_is_kept(tmp_path, monkeypatch):
    folder = tmp_path / "sets" / "t000"
    folder.mkdir(parents=True)
    (folder / "data.csv").write_text("y\n0\n")
    (folder / "model.py").write_text("")
    monkeypatch.setattr(rivals, "SETS", tmp_path / "sets")
    monkeypatch.setattr(records, "CACHE", tmp_path / "cache")
    told = tuple(records.Ranked(e, "v", str(k)) for k, e in enumerate("abcd"))
    calls = []
    monkeypatch.setattr(rivals, "of_folder", lambda path: calls.append(path) or ("effect", told, 3))
    for _ in range(2):
        record = rivals.recorded("t000", "loop", rivals.prepare)
        assert record.verdict == "effect"
        assert record.chosen == (("a", "v"), ("b", "v"), ("c", "v"))
        assert record.first_class == (("a", "v"),)
        assert not record.failed
    assert calls == [folder]
    monkeypatch.setattr(rivals, "method_digest", lambda: "another package")
    assert rivals.recorded("t000", "loop", rivals.prepare).digest != record.digest
