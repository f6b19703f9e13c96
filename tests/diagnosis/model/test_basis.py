"""The basis: what it holds for a model, and that its scores find products and what is past."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.data import check_parameters
from ssmppl.diagnosis.heldout import reference
from ssmppl.diagnosis.heldout.reference import significant_groups
from ssmppl.diagnosis.model.augment import augment
from ssmppl.diagnosis.model.basis import CURVES, REACH, TURNS, basis, symbolic_shapes
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.diagnosis.report import tables
from ssmppl.diagnosis.report.tables import WAVE_POINTS
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.diagnosis.screening.screen import ScreenDesign, run_screen
from ssmppl.diagnosis.verdict.decision import strongest_residual
from ssmppl.inference.run.problem import missing_of, pose
from ssmppl.inference.run.seeds import seed_sequence
from ssmppl.language.tracing import trace
from tests.diagnosis.harness import scales
from tests.diagnosis.model.test_forces import model_of
from tests.statistics.checks import seed_of

STEPS = 120
THETA = {"phi": 0.8, "b": 0.5, "q": 0.2, "r": 0.1}


def driven():
    """A level that is driven by an input and measured well."""
    model = ssm.Model("driven", inputs=("u",))

    @model.prior
    def prior():
        return {"phi": ssm.Uniform(-1, 1), "b": ssm.Normal(0, sd=1), "q": ssm.HalfNormal(sd=1),
                "r": ssm.HalfNormal(sd=1)}  # fmt: skip

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x, u, phi, b, q):
        return {"x": ssm.Normal(phi * x + b * u, sd=q)}

    @model.observation
    def observation(x, r):
        return {"y": ssm.Normal(x, sd=r)}

    return model


def simulated(missing, name):
    """Data of `driven` with missing(x, w, u) added to the transition, w the input's mean over
    `REACH` rows, exponentially weighted."""
    rng = np.random.default_rng(seed_of(name))
    u = rng.standard_normal(STEPS)
    x, w, out = rng.standard_normal(), 0.0, []
    for t in range(STEPS):
        out.append(x + 0.1 * rng.standard_normal())
        x, w = (0.8 * x + 0.5 * u[t] + missing(x, w, u[t]) + 0.2 * rng.standard_normal(),
                w + (u[t] - w) / REACH)  # fmt: skip
    return {"u": u, "y": np.array(out)}


def asked(data, sets=100):
    problem = pose(driven(), data)
    e = problem.experiments[0]
    scales = Scales.of(problem.trace, e.y[:, None, :].repeat(4, 1).reshape(-1, 1), e.y, e.u, STEPS)
    missing = missing_of(problem.experiments)
    design = ScreenDesign(
        problem.trace, scales, missing, tuple(THETA), Settings(), ["constant load"]
    )
    theta = check_parameters(problem.trace, THETA)
    return run_screen(
        design, problem.experiments, theta, sets, seed_sequence(5), Checkpoint(None, {})
    )


@pytest.fixture(scope="module")
def plain():
    return asked(simulated(lambda x, w, u: 0.0, "plain"), sets=60)


def test_what_it_holds(plain):
    terms = plain.design.terms
    found = {(t.equation, t.moment, t.variable): 0 for t in terms}
    for t in terms:
        found[t.equation, t.moment, t.variable] += 1
    assert found == {
        ("x", "mean", "x"): 4, ("x", "mean", "u"): 4, ("x", "mean", "x and u"): 6,
        ("x", "mean", "a Fourier series in x"): 10,
        ("x", "mean", "a fine Fourier series in x"): 12,
        ("x", "mean", "a very fine Fourier series in x"): 24,
        ("x", "mean", "a Fourier series in x times u"): 10,
        ("x", "mean", "the past of x"): 3, ("x", "mean", "the past of u"): 3,
        **{("x", "mean", f"the ringing of {v} at {turn:.0f} rows"): 2
           for v in ("x", "u") for turn in TURNS},
        ("x", "scale", "x"): 2, ("x", "scale", "u"): 2,
        ("y", "mean", "x"): 4, ("y", "scale", "x"): 2,
    }  # fmt: skip
    assert all(t.is_curve == (t.variable in ("x", "u")) for t in terms)
    assert all(t.series == (t.variable if "Fourier" in t.variable else "") for t in terms)


def test_a_simulator_has_the_longest_waves_alone():
    """Its functions are not compiled, and each costs its time in every row."""
    t = trace(model_of())
    series = {term.variable.partition(" series")[0] for term in basis(t, scales(t, 50))}
    assert {v for v in series if v.endswith("Fourier")} == {"a Fourier"}


def test_what_is_past_shares_its_states_and_its_scale(plain):
    trace, scales = plain.design.trace, plain.design.scales
    past = [t.candidate for t in basis(trace, scales) if t.variable == "the past of u"]
    made, shapes = symbolic_shapes(past)
    assert len(shapes) == 2
    assert len(augment(trace, made).state_symbols) == len(trace.state_symbols) + 3


def low_pass(state, z):
    first, second = state
    return (first + (z - first) / REACH, second + (first - second) / REACH), second


def ringing(state, z):
    """The real part of a rotation that dies away, driven along it; before the step."""
    keep = np.exp(-1.0 / TURNS[2])
    turned = keep * np.exp(2j * np.pi / TURNS[2]) * complex(*state)
    return (turned.real + 2.0 * (1.0 - keep) * z, turned.imag), state[0]


@pytest.mark.parametrize(
    ("name", "filtered"), [("past 2 of u", low_pass), ("ring 12 of u, phase 1", ringing)]
)
def test_the_score_of_what_is_past_is_the_exact_one(plain, name, filtered):
    """In a linear model, of a function of the input: r' S^-1 (y - m), r the response of y."""
    design, e = plain.design, plain.experiments[0]
    (k,) = [i for i, t in enumerate(design.terms) if t.candidate.effect.name == name]
    scale = design.scales.scale["u"]
    u, y = e.u[:, 0], e.y[:, 0]
    t = np.arange(STEPS)
    state, response, mean = (0.0, 0.0), [0.0], [0.0]
    for row in range(STEPS - 1):
        state, output = filtered(state, (u[row] - scale.mean) / scale.sd)
        response.append(0.8 * response[-1] + output)
        mean.append(0.8 * mean[-1] + 0.5 * u[row])
    var = np.array([0.8 ** (2 * s) + 0.04 * (1 - 0.8 ** (2 * s)) / (1 - 0.64) for s in t])
    cov = var[np.minimum.outer(t, t)] * 0.8 ** np.abs(np.subtract.outer(t, t)) + 0.01 * np.eye(
        STEPS
    )
    exact = np.array(response) @ np.linalg.solve(cov, y - np.array(mean))
    assert plain.observed.basis[k] == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize(
    ("variable", "missing"),
    [("x and u", lambda x, w, u: 0.15 * x * u), ("the past of u", lambda x, w, u: 0.3 * w)],
    ids=["product", "past"],
)
def test_what_no_curve_can_be_is_found(variable, missing):
    screen = asked(simulated(missing, variable))
    p, key = strongest_residual(screen, ())
    assert p <= 0.05
    assert key[0] == "x"  # its mean or, since q is held, its scale: which, hangs on the data set
    # rings that die away within a turn can be a low-pass, too
    found = {t.variable for terms, _ in significant_groups(screen, ()) for t in terms}
    assert any(v == variable or v.startswith(variable.replace("past", "ringing")) for v in found)
    curves = tables.missing_table(screen, ("x", "mean"), ())
    assert set(curves["variable"]) == {"x", "u"}


@pytest.mark.parametrize("turn", [7.0, 14.0, 25.0])
def test_a_resonance_is_found_at_its_own_frequency(turn):
    """One that dies away in three turns and is between two of those that are tried: it stands out
    of all groups, at a turn next to its own."""
    rng = np.random.default_rng(seed_of("resonance", turn))
    u, pole = rng.standard_normal(STEPS), np.exp((2j * np.pi - 1.0 / 3.0) / turn)
    x, ring, out = 0.0, 0j, []
    for t in range(STEPS):
        out.append(x + 0.1 * rng.standard_normal())
        x, ring = (0.8 * x + 0.5 * u[t] + 0.1 * ring.real / np.sqrt(turn / 14.0)
                   + 0.2 * rng.standard_normal(), pole * ring + u[t])  # fmt: skip
    screen = asked({"u": u, "y": np.array(out)})
    groups = reference.residual_groups(screen, ())
    best = max(groups, key=lambda key: groups[key].z)
    print(sorted(((round(g.z, 1), k[2]) for k, g in groups.items()), reverse=True)[:4])
    assert groups[best].p <= 0.01
    assert best[2].startswith("the ringing of")
    found = float(best[2].split(" at ")[1].split()[0])
    assert turn / 1.5 <= found <= turn * 1.5


@pytest.mark.parametrize("frequency", [4.0, 7.5])
@pytest.mark.parametrize("times", ["", " times u"])
def test_a_ripple_over_a_state_is_found(frequency, times):
    """Of so many radians in a standard deviation of it: finer than the curves follow, and between
    the waves that are tried. The table has one row for the place, with the finer of the two, and
    the curve goes up and down."""
    sd, size = 0.9, 0.4

    def missing(x, w, u):
        return size * np.sin(frequency * x / sd) * (u if times else 1.0)

    screen = asked(simulated(missing, f"ripple {frequency}{times}"))
    groups = reference.residual_groups(screen, ())
    best = max((key for key in groups if key[1] == "mean"), key=lambda key: groups[key].z)
    assert best == ("x", "mean", f"a Fourier series in x{times}")
    assert groups[best].p <= 0.01
    table, _ = tables.where_table(screen, 0.05)
    assert not table.duplicated(["equation", "moment"]).any()
    (row,) = table[(table["equation"] == "x") & (table["moment"] == "mean")].itertuples()
    assert row.region == f"with a Fourier series in x{times}"
    missing = tables.missing_table(screen, ("x", "mean"), ())
    over = missing["variable"].iloc[0]  # the ripple itself, in place of the smooth curve
    assert over.startswith("x where u = " if times else "x")
    assert set(missing["variable"]) == {over, "x", "u"}
    curve = missing[missing["variable"] == over]
    assert len(curve) == WAVE_POINTS
    true = size * np.sin(frequency * curve["value"] / sd)
    if times:
        true = true * float(over.partition(" = ")[2])
    assert np.corrcoef(curve["estimate"], true)[0, 1] > 0.5


def test_waves_are_level_where_the_data_seldom_are(plain):
    """Two standard deviations off a record tells nothing of the next ripple."""
    (term,) = [t for t in plain.design.terms if t.candidate.strength == "sin_3_waves_x_x"]
    function, shape = term.candidate.effect.function, {"centre": 1.0, "width": 0.5}
    inside = [float(function(0.0, z, 2.0, **shape)) for z in (1.1, 1.25)]
    assert inside == pytest.approx(2.0 * np.sin(3 * np.pi / 2 * np.array([0.2, 0.5])))
    outside = [float(function(0.0, z, 2.0, **shape)) for z in (2.0, 2.15, 5.1, -0.15, -7.1)]
    assert outside == pytest.approx([0.0] * 5, abs=1e-12)  # whole waves end there


def test_nothing_stands_out_of_a_right_model(plain):
    """No claim about the level: only that it does not cry out."""
    p, _ = strongest_residual(plain, ())
    assert p > 0.001


def test_the_curves_are_orthonormal_for_normal_values():
    nodes, weights = np.polynomial.hermite_e.hermegauss(60)
    values = np.stack([c(nodes) for c in CURVES])
    np.testing.assert_allclose(values @ np.diag(weights / weights.sum()) @ values.T, np.eye(4),
                               atol=1e-9)  # fmt: skip
