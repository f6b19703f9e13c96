"""Cells, modules and scripts that are run again declare the same functions, not further ones."""

import importlib
import pickle
import sys
import warnings

import pytest

import ssmppl as ssm
from ssmppl.errors import ModelError
from ssmppl.language.tracing import trace

DECLARED = """
@m.initial
def initial():
    return {"x": ssm.Normal(0, sd=1)}

@m.transition
def transition(x):
    return {"x": ssm.Normal(0.5 * x, sd=1)}

@m.observation
def observation(x):
    return {"y": ssm.Normal(x, sd=1)}
"""
RENAMED = DECLARED.replace("x", "z")
FASTER = DECLARED.replace("0.5", "0.9")
OTHER = """
@m.transition
def of_another_name(x):
    return {"x": ssm.Normal(0.5 * x, sd=1)}
"""
SECOND_STATE = """
@m.initial
def initial():
    return {"x": ssm.Normal(0, sd=1), "v": ssm.Normal(0, sd=1)}

@m.transition
def transition(v):
    return {"v": ssm.Normal(v, sd=1)}
"""


@pytest.fixture
def cell():
    """Runs a cell of a notebook, with the id that the front end gives it."""
    interactive = pytest.importorskip("IPython.core.interactiveshell").InteractiveShell
    shell = interactive.instance()

    def run(text, id=None):
        metadata = {} if id is None else {"cellId": id}
        shell.get_parent = lambda: {"metadata": metadata}
        result = shell.run_cell(text, store_history=True)
        if result.error_in_exec is not None:
            raise result.error_in_exec
        return shell.user_ns

    run("import ssmppl as ssm\nm = ssm.Model('m')")
    yield run
    interactive.clear_instance()


def functions(model):
    return {role: [f.__name__ for f in fs] for role, fs in model.functions.items() if fs}


ONCE = {"initial": ["initial"], "transition": ["transition"], "observation": ["observation"]}


@pytest.mark.parametrize("id", [None, "a1b2"])
def test_a_cell_that_is_run_again_declares_the_same_functions(cell, id):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(3):
            model = cell(DECLARED, id)["m"]
            trace(model)
    assert functions(model) == ONCE


@pytest.mark.parametrize("id", [None, "a1b2"])
def test_a_changed_cell_takes_the_place_of_what_it_was(cell, id):
    trace(cell(DECLARED, id)["m"])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        model = cell(FASTER, id)["m"]
        found = trace(model)
    said = [str(w.message) for w in told]  # of this one alone: the others are what they were
    assert [s.split(",")[0] for s in said] == ["@transition transition of model 'm' has changed"]
    assert "0.9" in repr(found.transition["x"].distribution.expressions())
    assert functions(model) == ONCE


@pytest.mark.filterwarnings("ignore:.* has changed")
def test_what_a_cell_declared_before_is_gone_with_its_names(cell):
    cell(DECLARED, "a1b2")
    assert list(trace(cell(RENAMED, "a1b2")["m"]).initial) == ["z"]


@pytest.mark.filterwarnings("ignore:.* has changed")
def test_functions_of_one_name_in_two_cells_are_two_functions(cell):
    cell(DECLARED, "a1b2")
    model = cell(SECOND_STATE, "c3d4")["m"]
    assert functions(model)["transition"] == ["transition", "transition"]
    assert set(trace(model).transition) == {"x", "v"}


@pytest.mark.parametrize("id", [None, "c3d4"])
def test_two_distributions_of_one_state_are_still_refused(cell, id):
    cell(DECLARED, "a1b2")
    with pytest.raises(ModelError, match="'x' is given by two @transition functions"):
        trace(cell(OTHER, id)["m"])


def test_a_function_declared_twice_in_one_run_is_refused(cell):
    cell(DECLARED)
    twice = "for _ in range(2):\n" + OTHER.replace("\n", "\n    ")
    with pytest.raises(ModelError, match="two @transition functions"):
        trace(cell("m = ssm.Model('m')\n" + DECLARED + twice)["m"])


def test_functions_that_a_loop_makes_are_kept(cell):
    text = (
        "m = ssm.Model('m')\n"
        "def of(name):\n"
        "    @m.transition\n"
        "    def law(x0, x1):\n"
        "        return {name: ssm.Normal(x0 - x1, sd=1)}\n"
        "for k in range(2):\n"
        "    of(f'x{k}')\n"
        "@m.initial\n"
        "def initial():\n"
        "    return {'x0': ssm.Normal(0, sd=1), 'x1': ssm.Normal(0, sd=1)}\n"
        "@m.observation\n"
        "def observation(x0):\n"
        "    return {'y': ssm.Normal(x0, sd=1)}\n"
    )
    assert set(trace(cell(text)["m"]).transition) == {"x0", "x1"}


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Functions in a module of their own, whose model is in another one."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    (tmp_path / "its_model.py").write_text("import ssmppl as ssm\nm = ssm.Model('m')\n")
    path = tmp_path / "its_functions.py"
    head = "import ssmppl as ssm\nfrom its_model import m\n"

    def write(text):
        path.write_text(head + text)
        importlib.invalidate_caches()

    yield write
    for name in ("its_model", "its_functions"):
        sys.modules.pop(name, None)


@pytest.mark.filterwarnings("ignore:.* has changed")
@pytest.mark.parametrize(("text", "states"), [(DECLARED, ["x"]), (RENAMED, ["z"])])
def test_a_module_that_is_loaded_again_declares_its_functions_anew(module, text, states):
    module(DECLARED)
    found = importlib.import_module("its_functions")
    module("\n\n" + text)  # the lines have moved
    importlib.reload(found)
    assert functions(found.m) == ONCE
    assert list(trace(found.m).initial) == states


def test_a_script_run_again_in_a_notebook_declares_its_functions_anew(cell, module, tmp_path):
    module(DECLARED)
    for _ in range(2):
        model = cell(f"%run {tmp_path / 'its_functions.py'}")["m"]
    assert functions(model) == ONCE


def make(model):
    """Declares functions as a library of the user's does."""

    @model.initial
    def initial():
        return {"x": ssm.Normal(0, sd=1)}

    @model.transition
    def transition(x):
        return {"x": ssm.Normal(x, sd=1)}

    return model


def test_models_that_a_function_makes_have_their_own_functions():
    made = [make(ssm.Model(f"m{k}")) for k in range(3)]
    assert [functions(m)["transition"] for m in made] == [["transition"]] * 3
    with pytest.raises(ModelError, match="'x' is given by two @initial functions"):
        trace(make(made[0]))


def test_a_model_travels_without_the_runs_of_its_cells():
    model = ssm.Model("m")
    model.prior(prior)
    there = pickle.loads(pickle.dumps(model))
    assert functions(there) == {"prior": ["prior"]}
    there.prior(prior)  # and can be declared further


def prior():
    return {}
