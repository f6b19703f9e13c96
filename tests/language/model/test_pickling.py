"""Models in pickles of Python's own: with lambdas, functions of functions, and of scripts."""

import copy
import pickle
import subprocess
import sys

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.expressions.arrays import ExprArray, array
from ssmppl.expressions.expr import symbol
from ssmppl.language.model import pickling
from tests.models import standard

DATA = {"y": np.array([0.3, -0.2, np.nan, 1.0])}
VALUES = {"q": 0.5}


def of_lambdas(sd=2.0) -> ssm.Model:
    model = ssm.Model("lambdas")
    model.prior(lambda: {"q": ssm.InverseGamma(2, scale=1)})
    model.initial(lambda: {"x": ssm.Normal(0, sd=sd)})
    model.transition(lambda x, q: {"x": ssm.Normal(x, variance=q)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1.0)})
    return model


def of_one_name() -> ssm.Model:
    """With a function of the user's own that is compiled, too."""
    model, slope = ssm.Model("one name"), 0.9

    @ssm.primitive
    def bent(x):
        return slope * x

    @model.prior
    def _():
        return {"q": ssm.InverseGamma(2, scale=1)}

    @model.initial
    def _():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def _(x, q):
        return {"x": ssm.Normal(bent(x), variance=q)}

    @model.observation
    def _(x):
        return {"y": ssm.Normal(x, sd=1.0)}

    return model


def of_itself() -> ssm.Model:
    """A function of which refers to it."""
    model = ssm.Model("itself")
    model.prior(lambda: {"q": ssm.InverseGamma(2, scale=float(len(model.name)))})
    model.initial(lambda: {"x": ssm.Normal(0, sd=1)})
    model.transition(lambda x, q: {"x": ssm.Normal(x, variance=q)})
    model.observation(lambda x: {"y": ssm.Normal(x, sd=1.0)})
    return model


def likelihood(model) -> float:
    return float(ssm.log_likelihood(model, DATA, VALUES, particles=50, seed=1).mean())


@pytest.mark.parametrize("make", [of_lambdas, of_one_name, of_itself])
@pytest.mark.parametrize("protocol", [2, pickle.HIGHEST_PROTOCOL])
def test_a_model_comes_back(make, protocol):
    model = make()
    again = pickle.loads(pickle.dumps(model, protocol))
    assert repr(again) == repr(model)
    assert likelihood(again) == likelihood(model)


def test_a_model_of_a_module_goes_by_the_names_of_its_functions():
    content = pickle.dumps(standard.varves)
    again = pickle.loads(content)
    assert again.functions["prior"] == [standard.varves_prior]
    assert len(content) < 1000


def test_what_a_pickle_holds_can_be_changed_alone():
    model = of_lambdas()
    for again in (copy.copy(model), copy.deepcopy(model), pickle.loads(pickle.dumps(model))):
        again.observation(lambda x: {"z": ssm.Normal(x, sd=2.0)})
        assert len(again.functions["observation"]) == 2
    assert len(model.functions["observation"]) == 1
    assert copy.deepcopy([model, model])[0].functions["prior"] == model.functions["prior"]


SCRIPT = """
import pickle, sys, ssmppl as ssm
model = ssm.Model("of a script")
sd = 2.0
@model.prior
def prior(): return {"q": ssm.InverseGamma(2, scale=1)}
@model.initial
def initial(): return {"x": ssm.Normal(0, sd=sd)}
@model.transition
def transition(x, q): return {"x": ssm.Normal(x, variance=q)}
@model.observation
def observation(x): return {"y": ssm.Normal(x, sd=1.0)}
with open(sys.argv[1], "wb") as file:
    pickle.dump(model, file)
"""


def test_another_process_reads_what_a_script_wrote(tmp_path):
    path = tmp_path / "model.pkl"
    subprocess.run([sys.executable, "-c", SCRIPT, str(path)], check=True)
    assert likelihood(pickle.loads(path.read_bytes())) == likelihood(of_lambdas(sd=2.0))


def test_what_expressions_share_is_packed_once():
    """As a model and its derivatives: hundreds of expressions over one long sum."""
    x = symbol("state", "x", ())
    common = x
    for k in range(400):
        common = np.sin(common) + k
    several = [common * k for k in range(2, 300)]
    table = array(several[:4]).reshape(2, 2)
    content = pickling.packed({"one": several, "again": {several[0]: common}, "table": table})
    assert len(content) < 3 * len(pickling.packed(common))
    back = pickling.unpacked(content)
    assert all(a is b for a, b in zip(back["one"], several, strict=True))
    assert back["again"] == {several[0]: common}
    assert isinstance(back["table"], ExprArray)
    assert back["table"].shape == (2, 2)
    assert [back["table"][i] is table[i] for i in np.ndindex(2, 2)] == [True] * 4


NOTHING_BUT_PICKLE = """
import sys
sys.modules["cloudpickle"] = None
from ssmppl.expressions.arrays import array
from ssmppl.expressions.expr import symbol
from ssmppl.language.model.pickling import packed, unpacked
x = symbol("state", "x", ())
there = {"e": 2 * x, "a": array([x, 2 * x])}
back = unpacked(packed(there))
assert back["e"] is there["e"] and back["a"][1] is there["e"]
"""


def test_expressions_are_packed_without_cloudpickle():
    subprocess.run([sys.executable, "-c", NOTHING_BUT_PICKLE], check=True, timeout=120)


def test_without_cloudpickle_it_is_refused_by_the_functions_line(monkeypatch):
    monkeypatch.setattr(pickling, "cloudpickle", None)
    with pytest.raises(ssm.ModelError, match="cannot be pickled with 'of_lambdas") as caught:
        pickle.dumps(of_lambdas())
    assert "pip install cloudpickle" in caught.value.fix
    assert caught.value.where.file == __file__
    assert "InverseGamma" in caught.value.where.text
    assert pickle.loads(pickle.dumps(standard.varves)).name == "varves"
