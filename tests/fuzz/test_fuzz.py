"""A few of the random models in every run; what the judge lets pass and what it does not."""

import warnings
from pathlib import Path

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.modelfile import load_model
from tests.fuzz.block import cases, recipe_of
from tests.fuzz.calls import Wrong, judged
from tests.fuzz.models import FAULTS, random_model

ROOT, DEFAULT, SLOW, ALL = 7, 2, 8, 30  # the root is none of those that the long runs took


def marks_of(number):
    """Compiling a random model takes seconds: few in every run, the rest in later stages."""
    if number < DEFAULT:
        return []
    return [pytest.mark.slow if number < SLOW else pytest.mark.exhaustive]


@pytest.mark.parametrize("number", [pytest.param(k, marks=marks_of(k)) for k in range(ALL)])
def test_random_models(number, tmp_path):
    failed = [o for o in cases(ROOT, number, tmp_path) if o.failed]
    told = "\n\n".join(f"{o.verb}: {o.kind}\n{o.detail}" for o in failed)
    assert not failed, f"{recipe_of(ROOT, number)[0].text}\n\n{told}"


INFINITE = """
import numpy as np
import ssmppl as ssm

model = ssm.Model('random', inputs=())


@model.prior
def prior():
    return {'p0': ssm.Beta(2, 2), 'p1': ssm.Gamma(2, rate=2), 'p2': ssm.HalfCauchy(scale=1)}


@model.initial
def initial(p0, p1, p2):
    share = 0.5 * (1 / (1 + np.exp(-(np.log(p0)))))
    first = (np.where(p0 > -0.558, p0, -0.558)) / (np.where(p2 > p1, p2, p1))
    mean = np.stack([first, (np.sin(0.909)) ** 3, np.arctan(np.maximum(p1, p0))])
    p = np.stack([share, share, 1 - 2 * share])
    return {'x0': ssm.Binomial(6, p0), 'x1': ssm.Categorical(p), 'x2': ssm.Normal(mean, sd=1.95)}


@model.transition
def transition(p0, p1, p2, x0, x1):
    mean = np.stack([(p0 - p0), np.arctan(np.log(p1)), (np.log(x0) - abs(x1))])
    return {'x0': ssm.Binomial(6, (1 / (1 + np.exp(-(np.tanh(-0.398)))))),
            'x1': ssm.Categorical(np.stack([0.2015, 0.2015, 0.597])),
            'x2': ssm.Normal(mean, precision=p2)}


@model.observation
def observation(p0, x0):
    mean = (0.1 + abs(np.maximum(x0, -0.768)))
    return {'y0': ssm.NegativeBinomial(mean, dispersion=(1 + np.sin((p0 - 0.337))))}
"""


def test_infinite_densities_are_no_comparison(tmp_path):
    """A model of a long run, whose density at two random points of the check is infinite."""
    file = tmp_path / "infinite.py"
    file.write_text(INFINITE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "p2" in str(ssm.explain(load_model(str(file))))


def warned():
    warnings.warn("divide by zero", RuntimeWarning, stacklevel=1)


def raising(error):
    def run():
        raise error

    return run


@pytest.mark.parametrize(
    ("run", "kind"),
    [
        (lambda: None, "result"),
        (raising(ssm.DataError("y is 3", fix="give less")), "DataError"),
        (raising(ssm.ModelError("x", fix="y", where="File \"m.py\", line 3")), "ModelError"),
        (raising(ssm.ModelError("x", fix="y")), "ERROR WITHOUT A PLACE"),
        (raising(ssm.ArgumentError("particles=0")), "ERROR WITHOUT A FIX"),
        (raising(ValueError("not ours")), "ERROR NOT OURS"),
        (raising(RecursionError()), "ERROR NOT OURS"),
        (raising(Wrong("nan")), "WRONG RESULT"),
        (warned, "WARNING OF NUMPY'S"),
    ],
)  # fmt: skip
def test_the_judge(run, kind):
    found = judged("verb", run, "m.py")
    assert found.kind == kind
    assert found.failed == kind.isupper()


def test_the_models_vary_and_are_the_same_for_the_same_number():
    texts = {recipe_of(1, k)[0].text for k in range(50)}
    assert len(texts) == 50
    assert recipe_of(1, 3)[0] == recipe_of(1, 3)[0]
    recipes = [random_model(np.random.default_rng(k), broken=0.7) for k in range(900)]
    assert {r.fault for r in recipes} == {"", *FAULTS}
    assert {support for r in recipes for support, _ in r.channels.values()} >= {"real", "label"}
    assert sum(r.linear for r in recipes) > 30


def test_a_wrong_result_is_found(tmp_path, monkeypatch):
    """A likelihood that is no number, and random numbers that a seed does not fix."""
    plain, count = ssm.simulate, [0]

    def another(*args, **more):
        count[0] += 1
        return plain(*args, **{**more, "seed": count[0]})

    monkeypatch.setattr(ssm, "log_likelihood", lambda *a, repeats=1, **k: np.full(repeats, np.nan))
    monkeypatch.setattr(ssm, "simulate", another)
    number = next(k for k in range(50) if not recipe_of(ROOT, k)[0].fault)
    found = list(cases(ROOT, number, Path(tmp_path)))
    wrong = {o.verb for o in found if o.kind == "WRONG RESULT"}
    assert {"log_likelihood", "simulate"} <= wrong
