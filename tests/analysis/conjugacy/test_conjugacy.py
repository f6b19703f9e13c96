"""The updates derived for a corpus of models: families, blocks, corrections."""

import re
from dataclasses import replace

import numpy as np
import pytest

from ssmppl.analysis.conjugacy import numerical_check
from ssmppl.analysis.conjugacy.derive import derive_updates
from ssmppl.analysis.conjugacy.numerical_check import verify
from ssmppl.analysis.conjugacy.separation import complete_data
from ssmppl.expressions.expr import to_text
from ssmppl.language import distributions as ssm
from ssmppl.language.model.model import Model
from ssmppl.language.tracing import trace
from tests.analysis.conjugacy.corpus import CORPUS, build


@pytest.mark.parametrize("name", CORPUS)
def test_corpus(name):
    model, blocks, corrections = build(name)
    updates = derive_updates(trace(model))
    found = sorted((u.block, u.family_name) for u in updates)
    expected = sorted(b[:2] for b in blocks for _ in range(b[2] if len(b) > 2 else 1))
    assert found == expected, "\n".join(str(u.explanation) for u in updates)
    outside = [to_text(u.functions[j]) for u in updates for j in u.outside_family]
    assert outside == list(corrections)


def test_the_check_notices_a_wrong_statistic():
    model, *_ = build("varves")
    data = complete_data(trace(model))
    (update,) = derive_updates(data.trace)
    assert verify(data, update) is None
    for role, factor in (("prior", 1.01), ("initial", 0.999), ("transition", 1.0001)):
        changed = tuple(factor * c for c in update.coefficients[role])
        wrong = replace(update, coefficients={**update.coefficients, role: changed})
        failure = verify(data, wrong)
        assert failure is not None, role
        assert "disagrees" in failure.reason


def test_the_check_notices_a_wrong_family():
    model, *_ = build("shared_precision")
    data = complete_data(trace(model))
    (update,) = derive_updates(data.trace)
    swapped = replace(update.family, log=update.family.pow, pow=update.family.log)
    failure = verify(data, replace(update, family=swapped))
    assert failure is not None
    assert "disagrees" in failure.reason


def test_fixed_parameters_have_no_update():
    model, *_ = build("intercept")
    updates = derive_updates(trace(model), fixed={"q", "c"})
    assert [(u.block, u.family_name) for u in updates] == [(("a",), "Normal")]


def test_precision_is_drawn_alone_when_its_partner_is_fixed():
    model, *_ = build("varves")
    (update,) = derive_updates(trace(model), fixed=["phi"])
    assert (update.block, update.family_name, update.outside_family) == (("tau",), "Gamma", ())


@pytest.mark.parametrize("name", CORPUS)
def test_explanations_have_every_part(name):
    model, *_ = build(name)
    for update in derive_updates(trace(model)):
        explanation = update.explanation
        assert explanation.title
        assert explanation.law
        assert update.needs_log_joint or explanation.statistics
        assert update.where is not None
        assert all(len(line) < 700 for line in str(explanation).splitlines())
        named = re.findall(
            r"(?:sampling from|Hastings with) the (.+?) distribution ",
            " ".join(str(explanation).split()),
        )
        assert all(n == update.family_name for n in named), named


@pytest.mark.parametrize(("name", "improper"), [("half_cauchy_sd", True), ("two_variances", False)])
def test_a_gamma_that_the_data_must_make_proper_is_told_so(name, improper):
    """A half-Cauchy prior gives the inverse Gamma of the square no positive shape of its own."""
    for update in derive_updates(trace(build(name)[0])):
        assert ("shape or rate not positive" in str(update.explanation)) == improper


def test_matrices_are_told_in_matrix_notation():
    told = {u.block: u.explanation for u in derive_updates(trace(build("vector_regression")[0]))}
    normal, wishart = told["A", "B", "c"], told["Q",]
    assert normal.title == "(A, B, c) jointly"
    assert normal.statistics == (
        "H: prior + sum_{t=2}^T kron(Q^-1, z z')",
        "h: prior + sum_{t=2}^T Q^-1 x z'",
        "z = (x_prev, u_prev, 1) in the mean of x",
    )
    assert wishart.law == "Q ~ inverse Wishart(df = 5 + (T - 1), scale S)"
    assert wishart.statistics == (
        "S: [[1, 0], [0, 1]] + sum_{t=2}^T r r'",
        "r = x - (A x_prev + B u_prev + c)",
    )


def test_a_parameter_that_no_law_reads_is_told_to_keep_its_prior():
    """Hyperparameters count as read; of their unread child the prior is the law given them."""
    model = Model("unread")
    model.prior(
        lambda: {
            "phi": ssm.Normal(0, sd=1), "b": ssm.Normal(2, sd=1), "u": ssm.Uniform(0, 1),
            "m": ssm.Normal(0, sd=1),
        }
    )  # fmt: skip
    model.prior(lambda m: {"c": ssm.Normal(1, sd=np.exp(m))})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, phi: {"x": ssm.Normal(phi * x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    told = {u.block: str(u.explanation) for u in derive_updates(trace(model))}
    unread = {b for b, text in told.items() if "not enter the model" in text}
    assert unread == {("b",), ("u",), ("c",)}, told
    assert "its posterior equals its prior, from which it is drawn" in told["b",]
    assert "/ H" not in told["b",]
    assert "its posterior equals its prior, updated by slice sampling" in told["u",]
    assert "its posterior, given m, equals its prior" in told["c",]


def test_blocks_are_compared_component_by_component_beside_vectors():
    """(phi, mu, r) jointly, with a factor left over that phi and mu alone leave too."""
    model = Model("beside")
    model.prior(lambda: {"a": ssm.Uniform(0, 0.5), "w": ssm.Gamma(np.ones(2), rate=1)})
    model.prior(lambda: {"r": ssm.LogNormal(0, sd=1)})
    model.prior(lambda a: {"phi": ssm.Uniform(a, 1), "mu": ssm.StudentT(3, a, scale=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=0.5)})
    model.transition(lambda x, phi, mu, r: {"x": ssm.Normal(phi * x + mu, sd=r)})
    model.observation(
        lambda x, w: {"y": ssm.Normal(x, sd=w[0]), "z": ssm.StudentT(4, x, scale=w[1])}
    )
    assert ("phi", "mu", "r") in {u.block for u in derive_updates(trace(model))}


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_the_search_for_the_line_of_a_fault_passes_infinite_densities():
    model = Model("edge")
    model.prior(lambda: {"p": ssm.Exponential(rate=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(np.sin(x), sd=1)})
    model.observation(lambda p: {
        "k": ssm.Bernoulli(0.5 + 0.5 * np.tanh(p**3)), "y": ssm.Normal(0, precision=p)
    })  # fmt: skip
    data = complete_data(trace(model))
    (update,) = derive_updates(data.trace)
    p = next(iter(update.components))
    rows = [
        {**row, p: np.full(numerical_check.POINTS, 50.0)}
        for row in numerical_check.random_series(data, np.random.default_rng(1))
    ]
    for row in rows:
        row.update({s: np.zeros(numerical_check.POINTS) for s in data.trace.observation_symbols})
    changed = {p: np.full(numerical_check.POINTS, 60.0)}
    (line,) = {f.where for f in data.holding([p]) if f.role == "observation"}
    assert numerical_check._culprit(data, update, rows, changed) in (None, line)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_statistics_of_both_infinities_are_no_number():
    model = Model("mean")
    model.prior(lambda: {"m": ssm.Normal(0, sd=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(np.sin(x), sd=1)})
    model.observation(lambda x, m: {"y": ssm.Normal(m + x, sd=1)})
    data = complete_data(trace(model))
    (update,) = derive_updates(data.trace)
    rows = numerical_check.random_series(data, np.random.default_rng(1))
    for t, row in enumerate(rows):
        row.update(
            {
                s: np.full(numerical_check.POINTS, (-1) ** t * np.inf)
                for s in data.trace.state_symbols
            }
        )
    assert np.isnan(numerical_check.summed_statistics(update, rows)).any()


@pytest.mark.parametrize("bounds", [(-1, 20), (-20, 1), (-0.1, np.inf), (-np.inf, 0.1)])
def test_no_update_that_holds_on_one_side_of_zero_only(bounds):
    """log(a**2) is 2 log(a) where a is positive, which most of these supports are."""
    model = Model("square")
    low, high = bounds
    if np.isinf(low) or np.isinf(high):
        cut = {"lower": low} if np.isinf(high) else {"upper": high}
        model.prior(lambda: {"a": ssm.Truncated(ssm.Normal(0, sd=30), **cut)})
    else:
        model.prior(lambda: {"a": ssm.Uniform(low, high)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, a: {"x": ssm.Normal(np.sin(x), variance=a**2)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    (update,) = derive_updates(trace(model))
    assert update.needs_log_joint
    assert not update.functions
