"""Model files written from traces: the same laws, expression by expression, and a person's text."""

import ast
import linecache
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.diagnosis.model.augment import augment
from ssmppl.diagnosis.model.changed_laws import substituted
from ssmppl.diagnosis.report.model_file import model_text, terms_with, to_model
from ssmppl.errors import ArgumentError, ModelError
from ssmppl.expressions.calculus import differentiate
from ssmppl.expressions.expr import symbol
from ssmppl.language.tracing import trace
from ssmppl.modelfile import load_model
from tests.diagnosis.harness import EVERY, differences, offered, traced
from tests.language.user_defined.user_defined_laws import Gumbel


def assert_round_trip(t):
    """The file's laws are the trace's; written again it is the same text; its lines are short."""
    text = model_text(t)
    again = trace(to_model(t))
    assert differences(t, again) == []
    assert model_text(again) == text
    assert max(map(len, text.split("\n"))) <= 100


@pytest.mark.parametrize(("where", "name"), EVERY)
def test_models_are_written_as_they_are(where, name):
    assert_round_trip(traced(where, name))


@pytest.mark.parametrize("name", ["oscillator", "ar1", "epidemic"])
def test_augmented_models_are_written_as_they_are(name):
    """The first of each group by itself, and all candidates together."""
    t, found = traced("gap", name), offered("gap", name)[0]
    for c in {c.group: c for c in reversed(found)}.values():
        assert_round_trip(augment(t, [c]))
    assert_round_trip(augment(t, found))


@pytest.mark.slow
@pytest.mark.parametrize(("where", "name"), EVERY)
def test_every_candidate_of_every_model_is_written(where, name):
    t, found = traced(where, name), offered(where, name)[0]
    for c in {c.group: c for c in found}.values():  # shapes are but other numbers
        assert_round_trip(augment(t, [c]))
    assert_round_trip(augment(t, found))


def test_priors_of_vectors_are_written_as_they_are():
    model = ssm.Model("vectors")

    @model.prior
    def prior():
        return {
            "R": ssm.LKJ(3, 1.5), "p": ssm.LogisticNormal([0.5, -1], covariance=np.eye(2)),
            "level": ssm.Ordered(ssm.Normal(np.zeros(3), sd=2)),
            "rate": ssm.Ordered(ssm.Gamma([1.0, 3.0], rate=0.5)),
        }  # fmt: skip

    @model.initial
    def initial():
        return {"x": ssm.Normal(np.zeros(3), sd=1)}

    @model.transition
    def transition(x, R, p, level, rate):
        return {"x": ssm.MvStudentT(5, level + p * x, scale=rate[0] * R)}

    @model.observation
    def observation(x, rate):
        return {"y": ssm.Normal(x, sd=rate[1])}

    assert_round_trip(trace(model))


def model_of(mean, **more):
    """A model whose observation has the given mean of x, z, a, P."""
    model = ssm.Model("made")

    @model.prior
    def prior():
        return {"a": ssm.Normal(0, sd=1), "P": ssm.Wishart(4, scale=np.eye(2))}

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1), "z": ssm.Normal(np.zeros(2), sd=1)}

    @model.transition
    def transition(x, z):
        return {"x": ssm.Normal(x, sd=1), "z": ssm.Normal(0.5 * z, sd=1)}

    @model.observation
    def observation(x, z, a, P):
        return {"y": ssm.Normal(mean(x, z, a, P), sd=1)}

    return model


@pytest.mark.parametrize(
    "mean",
    [
        lambda x, z, a, P: -(x / a) + (-x / a),
        lambda x, z, a, P: -(x * a) * z[0] - x * (a * z[1]),
        lambda x, z, a, P: -(x % a) * 2 - (x // a),
        lambda x, z, a, P: (-2.0) ** x + x**-2 + (-x) ** a + -(x**a) + (x**2) ** a + x ** (a**2),
        lambda x, z, a, P: x - (a - z[0]) - (x + (a + z[1])),
        lambda x, z, a, P: x / (a / z[0]) / (x * a),
        lambda x, z, a, P: x - -0.1 * a + (-3.0 + a),
        lambda x, z, a, P: np.where((x < 1) & ((a <= 2) | ~(x == a)), x != 3, 0.5),
        lambda x, z, a, P: np.where(np.equal(x, 2), 1.0, 2.0) * np.where(np.equal(2.0, x), 3.0, a),
        lambda x, z, a, P: np.logaddexp(x, a) + np.arctan2(x, 1e-300) + np.hypot(x, a),
        lambda x, z, a, P: 1e300 * x + 1e-5 * a + 123456789.125 * x + 1e16 * x,
        lambda x, z, a, P: np.exp(np.exp(x) + a) * np.exp(x) + 1 / (np.exp(x) + a),
        lambda x, z, a, P: np.linalg.solve(P, z)[0] + np.linalg.det(P + 1) * x,
        lambda x, z, a, P: np.minimum(np.inf, x) + np.linalg.inv(P)[0, 1],
        lambda x, z, a, P: np.stack([x, a]) * z,
        lambda x, z, a, P: P @ z + 2.0 * z - np.tanh(z) / (1 + z**2),
        lambda x, z, a, P: np.outer(z, z) + x * np.eye(2),
        lambda x, z, a, P: np.stack([np.outer(z, z), P]),
        lambda x, z, a, P: np.stack([a * x]),
        lambda x, z, a, P: np.stack([x, x, x]),
        lambda x, z, a, P: np.full((2, 2), 1.5) * x,
    ],
)
def test_spelling_keeps_order_and_grouping(mean):
    assert_round_trip(trace(model_of(mean)))


def test_special_functions_are_imported():
    from scipy import special

    t = trace(model_of(lambda x, z, a, P: special.gammaln(1 + x**2) + special.psi(a) * x))
    assert "from scipy import special" in model_text(t)
    assert_round_trip(t)


def test_an_augmented_model_reads_as_written_by_a_person():
    t, found = traced("gap", "oscillator"), offered("gap", "oscillator")[0]
    wanted = {"quadratic_drag_v", "actuator_lag_u", "parameter_drift_k"}
    added = [c for c in found if c.strength in wanted]
    text = model_text(augment(t, added), 'An "oscillator"', ["Written by a test."], added)
    assert text.startswith('"""An "oscillator"\n\nWritten by a test.\n"""\n')
    assert "    # added: quadratic drag in v\n    quadratic_drag = quadratic_drag_v * v *" in text
    assert "    actuator_lag = u + actuator_lag_u * (lagged_u_next - u)\n" in text
    assert "    relative_drift = k * np.exp(parameter_drift_k * (t / 300 - 0.5))\n" in text
    assert '"x": ssm.Dirac(x + 0.1 * v)' in text
    ast.parse(text)


def test_a_written_file_is_a_model_file(tmp_path):
    t, found = traced("gap", "two_tanks"), offered("gap", "two_tanks")[0]
    new = augment(t, found[::9])
    path = tmp_path / "tanks.py"
    path.write_text(model_text(new, added=found[::9]), encoding="utf-8")
    assert differences(new, trace(load_model(str(path)))) == []


def test_errors_show_the_lines_of_the_text():
    model = to_model(traced("gap", "ar1"))
    place = trace(model).transition["x"].where
    assert linecache.getline(place.file, place.line).startswith("def transition(x, phi, q):")


def test_vectors_and_matrices_keep_their_notation():
    text = model_text(traced("gap", "vector"))
    assert "A @ x + b * u" in text
    assert "ssm.Normal(x, sd=r)" in text
    assert 'inputs={"force": 2}' in model_text(traced("features", "linear_vector"))


def test_terms_of_an_effect_that_stand_in_several_equations_are_all_marked():
    """They were compared as numbers, which have no truth while a model is traced."""
    strength, x, y = (symbol("parameter", n, ()) for n in "sxy")
    first, second = strength * x, strength * y
    found = terms_with([first + y, second + first], strength)
    assert [id(e) for e in found] == [id(first), id(second)]


def test_hierarchies_of_priors_stay_in_order():
    text = model_text(traced("corpus", "hierarchy"))
    assert text.index("def prior():") < text.index("def prior_2(mu, lam):")


@ssm.primitive
def importable(v):
    return 0.1 if v > 0.0 else -0.1


def test_primitives_are_imported_from_the_users_file():
    t = trace(model_of(lambda x, z, a, P: importable(x) + a))
    text = model_text(t)
    assert "from tests.diagnosis.report.test_writing import importable" in text
    assert f"sys.path.append({str(Path(__file__).parents[3])!r})" in text
    assert_round_trip(t)


@ssm.primitive(derivative=lambda v: 2.0 * v)
def square(v):
    return v * v


@ssm.primitive
def halves(v, w):
    return 0.5 * v, 0.5 * w


def test_derivatives_of_primitives_and_their_several_numbers_are_spelled():
    """As effects have them that look at the slopes of a step."""

    def mean(x, z, a, P):
        first, second = halves(x, a)
        slopes = differentiate([square(x) + halves.difference((1, 0))(x, a)[0]], x)
        return slopes[0] + first * second

    t = trace(model_of(mean))
    text = model_text(t)
    assert "square.given[None](x)" in text
    assert "halves.difference((2, 0))(x, a)" in text
    assert "import halves" in text
    assert_round_trip(t)


@ssm.primitive
def total(v):
    return 0.1 if v > 0.0 else -0.1


@ssm.primitive
def y_mean(v):
    return 0.2 if v > 0.0 else -0.2


@ssm.primitive
def x(v):
    return 0.1 * v


def test_locals_do_not_take_the_names_of_what_is_imported():
    """Sums that are written once are called `total`, and a mean `y_mean`, unless they are taken."""

    def mean(x, z, a, P):
        s = a * x + np.exp(-x) * a + 3 * np.sin(x)
        return total(s) + s * y_mean(s)

    t = trace(model_of(mean))
    assert "total_2 = " in model_text(t)
    assert "\n    total = " not in model_text(t)
    assert "y_mean = " not in model_text(t)
    assert_round_trip(t)


def test_two_things_of_one_name_are_refused():
    call = x
    with pytest.raises(ArgumentError, match="two things named 'x', one of them a primitive"):
        model_text(trace(model_of(lambda x, z, a, P: call(x))))
    named = ssm.primitive(importable.function)
    named.__name__ = "total"
    with pytest.raises(ArgumentError, match="two things named 'total'"):
        model_text(trace(model_of(lambda x, z, a, P: total(x) + named(x))))


def test_a_primitive_that_no_file_can_import_is_refused():
    @ssm.primitive
    def local(v):
        return v + 1.0

    t = trace(model_of(lambda x, z, a, P: local(x)))
    with pytest.raises(ArgumentError, match="'local' is defined inside of a function"):
        model_text(t)


@pytest.mark.parametrize("name", ["loose_friction", "dc-motor", "01_motor", "class"])
def test_a_primitive_of_a_loose_file_is_found_by_its_folder(tmp_path, name):
    """`from dc-motor import rub` is no Python, at the end of a whole diagnosis."""
    (tmp_path / f"{name}.py").write_text(
        "import ssmppl as ssm\n\n@ssm.primitive\ndef rub(v):\n    return -0.5 * v\n\n"
        'model = ssm.Model("loose")\n\n'
        "@model.initial\ndef initial():\n    return {'x': ssm.Normal(0, sd=1)}\n\n"
        "@model.transition\ndef transition(x):\n    return {'x': ssm.Normal(rub(x), sd=1)}\n\n"
        "@model.observation\ndef observation(x):\n    return {'y': ssm.Normal(x, sd=1)}\n"
    )
    t = trace(load_model(str(tmp_path / f"{name}.py")))
    assert ("import rub" in model_text(t)) == (name == "loose_friction")
    assert f"sys.path.append({str(tmp_path)!r})" in model_text(t)
    assert model_text(trace(to_model(t))) == model_text(t)
    (tmp_path / "written.py").write_text(model_text(t))
    again = trace(load_model(str(tmp_path / "written.py")))
    assert model_text(again) == model_text(t)


def test_a_file_that_cannot_be_imported_is_refused(tmp_path):
    file = tmp_path / "dc.motor.py"
    text = "import ssmppl as ssm\n\n@ssm.primitive\ndef rub(v):\n    return -0.5 * v\n"
    file.write_text(text)
    space = {"__name__": "__main__"}
    exec(compile(text, str(file), "exec"), space)
    rub = space["rub"]
    t = trace(model_of(lambda x, z, a, P: rub(x)))
    with pytest.raises(ArgumentError, match=r"dc\.motor\.py, which cannot be imported"):
        model_text(t)


def test_a_script_does_not_run_again(tmp_path):
    """Its import ran the whole of it, a diagnosis at its end included."""
    (tmp_path / "script.py").write_text(
        "import ssmppl as ssm\nfrom ssmppl.diagnosis.report.model_file import to_model\n"
        "from ssmppl.language.tracing import trace\n\n"
        "print('begun')\n\n@ssm.primitive\ndef rub(v):\n    return -0.5 * v\n\n"
        'model = ssm.Model("loose")\n'
        "model.initial(lambda: {'x': ssm.Normal(0, sd=1)})\n"
        "model.transition(lambda x: {'x': ssm.Normal(rub(x), sd=1)})\n"
        "model.observation(lambda x: {'y': ssm.Normal(x, sd=1)})\n"
        "to_model(trace(model))\nprint('ended')\n"
    )
    done = subprocess.run(
        [sys.executable, "script.py"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == ["begun", "ended"]


@pytest.mark.parametrize("name", ['motor "A"', '"', 'it\'s "A"', '"""', "C:\\", '\\"', 'a"""b""'])
def test_names_with_quotes(name):
    model = ssm.Model(name)
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(0.5 * x, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1)})
    assert to_model(trace(model)).name == name
    space = {}
    exec(model_text(trace(model), notes=["fitted"]), space)
    assert space["model"].name == name
    exec(model_text(trace(model)), space)
    assert space["__doc__"] == name


def test_names_that_the_file_needs_are_refused():
    model = ssm.Model("clash")

    @model.initial
    def initial():
        return {"np": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(np):
        return {"np": ssm.Normal(np, sd=1)}

    with pytest.raises(ArgumentError, match="named 'np'"):
        model_text(trace(model))


def test_what_has_no_spelling_is_named():
    model = ssm.Model("odd")

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x):
        quantile = ssm.Poisson(np.exp(x)).quantile(0.5)
        return {"x": ssm.Normal(quantile[()], sd=1)}

    with pytest.raises((ArgumentError, ModelError), match="poisson_quantile"):
        model_text(trace(model))


def lawful(law):
    """A model with a law of one's own in every place."""
    model = ssm.Model("lawful")
    model.prior(lambda: {"a": law(0.5, scale=0.1)})
    model.initial(lambda a: {"x": law(a, 2.0), "v": law(np.zeros(2), 2.0)})
    model.transition(
        lambda x, v, a: {"x": law(a * x, 0.3), "v": law(0.5 * v + a, scale=np.array([1.0, 2.0]))}
    )
    model.observation(
        lambda x, v: {
            "y": law(x, 0.2), "z": law(v, 0.3),
            "w": ssm.Truncated(law(x, np.ones(2)), lower=-9),
        }
    )  # fmt: skip
    return model


def test_laws_of_ones_own_are_imported_from_the_users_file():
    t = trace(lawful(Gumbel))
    text = model_text(t)
    assert "from tests.language.user_defined.user_defined_laws import Gumbel" in text
    assert "Gumbel(loc=a*x, scale=0.3)" in text.replace(" * ", "*")
    assert_round_trip(t)


def test_a_law_that_no_file_can_import_is_refused():
    @ssm.distribution
    def Local(y, loc, scale):
        return -np.abs(y - loc) / scale - np.log(2 * scale)

    Local.quantile(lambda p, loc, scale: loc + scale * np.sign(p - 0.5) * np.log(2 * p))
    Local.cdf(lambda y, loc, scale: 0.5 + 0.0 * y)
    with pytest.raises(ArgumentError, match="the distribution 'Local' is defined inside of a f"):
        model_text(trace(lawful(Local)))


def test_effects_reach_the_arguments_of_a_law_of_ones_own():
    """A parameter that breaks is another one in the law's arguments, and the law stays."""
    t = trace(lawful(Gumbel))
    a, other = symbol("parameter", "a"), symbol("parameter", "b")
    d = t.transition["x"].distribution
    new = substituted(d, {a: other})
    assert repr(new) == "Gumbel(loc=b*x_prev, scale=0.3)"
    assert new.location == d.location
    assert substituted(new, {other: a}).log_density(other) is d.log_density(other)
    bounded = substituted(t.observations["w"].distribution, {symbol("state", "x"): other})
    assert bounded.base.shape == (2,)
    assert "loc=b" in repr(bounded)
