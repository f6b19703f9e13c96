"""The nearest formula of a missing term: scores made from a known one give it back."""

from types import SimpleNamespace

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.model.basis import basis
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.diagnosis.screening.location import BasisGroupScore
from ssmppl.diagnosis.screening.nearest_formula import chosen, nearest_formula, written
from ssmppl.language.tracing import trace
from tests.statistics.checks import seed_of

ROWS = 2000


def spring():
    model = ssm.Model("spring", inputs=("u",))
    model.prior(lambda: {"k": ssm.LogNormal(0, sd=1), "c": ssm.LogNormal(-1, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1), "v": ssm.Normal(0, sd=1)})

    @model.transition
    def transition(x, v, u, k, c):
        return {"x": ssm.Dirac(x + 0.1 * v),
                "v": ssm.Normal(v + 0.1 * (u - k * x - c * v), sd=0.3)}  # fmt: skip

    model.observation(lambda x: {"y": ssm.Normal(x, sd=0.1)})
    return model


@pytest.fixture(scope="module")
def visited():
    """A spring with an input, the values that its variables take, and the terms of its speed."""
    traced = trace(spring())
    rng = np.random.default_rng(seed_of("nearest formula"))
    states, inputs = rng.normal(size=(ROWS, 2)) * [0.7, 1.5], rng.normal(size=(ROWS, 1))
    scales = Scales.of(traced, states, states[:, :1], inputs, ROWS)
    terms = [t for t in basis(traced, scales) if (t.equation, t.moment) == ("v", "mean")]
    values = {"x": states[:, 0], "v": states[:, 1], "u": inputs[:, 0]}
    return SimpleNamespace(scales=scales, terms=[t for t in terms if t.factors], values=values)


def on_the_rows(visited):
    """(ROWS, D) the terms' values."""
    curves = {t.factors[0]: t for t in visited.terms if len(t.factors) == 1}
    out = []
    for t in visited.terms:
        parts = [curves[v, k].at(visited.values[v]) for v, k in t.factors]
        out.append(np.prod(parts, axis=0))
    return np.array(out).T


def scored(visited, missing, noise=0.3, absorbed=()):
    """The efficient scores of the terms where `missing` (ROWS,) is in a mean with that noise, with
    regressors projected out, and the information before."""
    rng = np.random.default_rng(seed_of("scores", len(missing)))
    design = on_the_rows(visited)
    y = missing + noise * rng.normal(size=ROWS)
    whole = design.T @ design / noise**2
    for a in absorbed:
        a = a / np.linalg.norm(a)
        design, y = design - np.outer(a, a @ design), y - a * (a @ y)
    v = design.T @ design / noise**2
    score = design.T @ y / noise**2
    return BasisGroupScore(
        score, v, np.linalg.pinv(v), 0.0, 9.0, np.zeros(1), 1.0, len(v), 0.0
    ), whole


def found(visited, missing, **options):
    group, whole = scored(visited, missing, **options)
    offered = written(visited.terms, visited.scales.scale)
    return chosen("v", offered, group, whole, ROWS)


def test_drag_is_found(visited):
    v = visited.values["v"]
    answer = found(visited, -0.4 * v * np.abs(v))
    assert answer.terms == ("v*np.abs(v)",)
    assert answer.coefficients[0] == pytest.approx(-0.4, abs=0.04)
    assert 0.9 < answer.share <= 1.0


def test_what_the_parameters_absorb_is_no_term(visited):
    """With the damping free, what is left of a drag is any odd law that bends."""
    v = visited.values["v"]
    answer = found(visited, -0.4 * v * np.abs(v), absorbed=[v])
    assert answer.terms in [("v*np.abs(v)",), ("v**3",)]
    assert answer.coefficients[0] < 0.0
    group, whole = scored(visited, 0.4 * v, absorbed=[v])
    offered = written(visited.terms, visited.scales.scale)
    assert chosen("v", {"v": offered["v"]}, group, whole, ROWS) is None


def test_two_terms_are_found_together(visited):
    x, u = visited.values["x"], visited.values["u"]
    answer = found(visited, 0.5 * x**2 - 0.3 * x * u)
    assert set(answer.terms) == {"x**2", "x*u"}
    by_term = dict(zip(answer.terms, answer.coefficients, strict=True))
    assert by_term["x**2"] == pytest.approx(0.5, abs=0.05)
    assert by_term["x*u"] == pytest.approx(-0.3, abs=0.03)


def test_a_coefficient_lies_within_its_error(visited):
    """Of what the functions write exactly, as often as it should."""
    off = []
    for k in range(40):
        rng = np.random.default_rng(seed_of("errors", k))
        design, noise = on_the_rows(visited), 0.3
        a = written(visited.terms, visited.scales.scale)["np.sin(u)"]
        y = 0.2 * design @ a + noise * rng.normal(size=ROWS)
        v = design.T @ design / noise**2
        group = BasisGroupScore(design.T @ y / noise**2, v, np.linalg.pinv(v), 0.0, 9.0,
                                np.zeros(1), 1.0, len(v), 0.0)  # fmt: skip
        answer = chosen("v", {"np.sin(u)": a}, group, v, ROWS)
        off.append((answer.coefficients[0] - 0.2) / answer.errors[0])
    assert 0.7 < np.std(off) < 1.35  # 0.99 of the standard deviations of 40 normal numbers


def test_nothing_is_named_by_chance(visited):
    named = [found(visited, np.zeros(ROWS), noise=0.3 + 0.01 * k) is not None for k in range(20)]
    assert not any(named)


def test_no_root_of_what_is_negative(visited):
    offered = written(visited.terms, visited.scales.scale)
    assert not any("sqrt" in text for text in offered)
    level = Scales.of(trace(spring()), np.abs(np.stack([visited.values["x"]] * 2, axis=1)),
                      visited.values["x"][:, None], visited.values["u"][:, None], ROWS)  # fmt: skip
    assert "np.sqrt(x)" in written(visited.terms, level.scale)


def test_of_a_screen_the_place_counts_and_the_others_are_projected_out(visited):
    v = visited.values["v"]
    group, whole = scored(visited, -0.4 * v * np.abs(v))
    asked = []

    def basis_group(own, others):
        asked.append((own, others))
        return group

    root = np.linalg.cholesky(whole + 1e-9 * np.eye(len(whole)))
    screen = SimpleNamespace(
        design=SimpleNamespace(terms=visited.terms, scales=visited.scales), basis_group=basis_group,
        simulated=SimpleNamespace(basis=np.sqrt(len(whole)) * root.T),
        experiments=[SimpleNamespace(steps=ROWS)],
    )  # fmt: skip
    assert nearest_formula(screen, ("v", "mean"), ["other"]).terms == ("v*np.abs(v)",)
    assert asked == [(list(range(len(visited.terms))), ["other"])]
    assert nearest_formula(screen, ("x", "mean"), []) is None
