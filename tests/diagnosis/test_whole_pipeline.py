"""`ssm.diagnose` from end to end on 60 rows of every kind of model: it ends in a report or in an
error of this package, and in nothing else.

What the numbers are is for other tests: here a few simulated sets, particles and effects do. The
effects are a sample for each model, so that all of them get their turn.
"""

import warnings
import zlib
from collections.abc import Mapping

import numpy as np
import pandas as pd
import pytest

import ssmppl as ssm
from ssmppl.diagnosis import diagnose
from ssmppl.diagnosis.fitting import fit
from ssmppl.diagnosis.heldout import cross_validation, predictions
from ssmppl.diagnosis.report.report import GapReport
from ssmppl.diagnosis.screening import screen
from ssmppl.diagnosis.selection import effect_selection, refit_test
from ssmppl.errors import SSMError
from ssmppl.language.distributions import Flat, HalfFlat
from ssmppl.modelfile import load_model, read_csv
from tests.analysis.conjugacy import corpus
from tests.diagnosis.every import FILES, MODELS, candidates, traced
from tests.models import gaps as models

ROWS, MORE_SETS, PARTICLES, BLOCKS = 60, 32, 30, 5
SAMPLE = {"fast": 12, "full": 6}  # effects tried
ALWAYS = ["coulomb friction", "bouc-wen hysteresis", "coarse discretisation"]  # in full mode
ALPHA = {"fast": 0.05, "full": 0.45}  # so large that effects are chosen, pairs of them and steps
RECORDS = {"pendulum_opaque": "pendulum_steps"}  # the same record
# Of every kind of state, noise and channel, with what has failed before among them.
FEW = {
    "fast": [("gap", "epidemic"), ("gap", "vector"), ("gap", "simulator"), ("bench", "thermal"),
             ("example", "nile"), ("example", "coal_mines"), ("corpus", "negative_binomial"),
             ("case", "silverbox"), ("case", "pendulum_opaque")],
    "full": [("case", "emps"), ("case", "gusts"), ("case", "tclab"), ("gap", "ar1")],
}  # fmt: skip


def few(patch, where, name):
    """Every number that only takes time; sets as many as the model's parameters need."""
    sets = MORE_SETS + len(traced(where, name).parameter_symbols)
    patch.setattr(diagnose, "SETS", {"fast": sets, "full": sets})
    patch.setattr(screen, "OWN_RUNS", 2)
    patch.setattr(screen, "FEWEST", sets // 2)
    patch.setattr(effect_selection, "AGAIN", sets)
    patch.setattr(refit_test, "SETS", 3)
    patch.setattr(fit, "INFORMATION_SETS", 6)
    patch.setattr(fit, "PILOT_PARTICLES", PARTICLES)
    patch.setattr(cross_validation, "SETS", sets)
    patch.setattr(cross_validation, "SINGLES", 1)
    patch.setattr(predictions, "FREE_RUNS", 10)
    for module in (diagnose, cross_validation):
        patch.setattr(module, "FOLDS", BLOCKS)


def model_of(where, name):
    if (where, name) in FILES:
        return load_model(str(FILES[where, name]))
    return models.build(name) if where == "gap" else corpus.build(name)[0]


def data_of(where, name):
    """The first rows of a record, or such as the model gives."""
    if (where, name) in FILES:
        folder = FILES[where, name].parent
        csv = folder / f"{RECORDS.get(name, name)}.csv"
        records = sorted(folder.glob("*.csv")) if where == "example" else [csv]
        if records[0].exists():
            read = read_csv(records[0])
            return read[:ROWS] if isinstance(read, pd.DataFrame) else read
    if where == "gap":
        return models.simulated(name, ROWS)
    t, rng = traced(where, name), np.random.default_rng(zlib.crc32(name.encode()))
    inputs = {n: rng.uniform(0.2, 1.0, (ROWS, *shape)) for n, shape in t.inputs.items()}
    improper = any(isinstance(s.distribution, (Flat, HalfFlat)) for s in t.parameters.values())
    theta = {n: half(s.shape) for n, s in t.parameters.items()} if improper else None
    drawn = ssm.simulate(model_of(where, name), theta, steps=ROWS, inputs=inputs or None, seed=1)
    return inputs | {n: drawn[n].values[0] for n in t.observations}


def half(shape):
    """A value for a parameter; of a matrix such as a covariance can be."""
    square = len(shape) == 2 and shape[0] == shape[1]
    return 0.5 * np.eye(shape[0]) if square else np.full(shape, 0.5)


def chosen(where, name, mode):
    """The names of a few effects that apply."""
    names = list(dict.fromkeys(c.effect.name for c in candidates(where, name)))
    rng = np.random.default_rng(zlib.crc32(f"{where} {name} {mode}".encode()))
    always = [n for n in ALWAYS if n in names] if mode == "full" else []
    return list(dict.fromkeys([*always, *map(str, rng.permutation(names)[: SAMPLE[mode]])]))


def ends(where, name, mode):
    """The report, or the error of this package; any other error is raised."""
    data = data_of(where, name)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return ssm.diagnose(
                model_of(where, name), data, chosen(where, name, mode), mode=mode,
                alpha=ALPHA[mode], particles=PARTICLES, progress=False,
            )  # fmt: skip
    except SSMError as error:
        return error


def cases(mode, models):
    return [pytest.param(*m, mode, id=f"{'-'.join(m)}-{mode}") for m in models]


def check(patch, where, name, mode):
    few(patch, where, name)
    found = ends(where, name, mode)
    assert isinstance(found, (GapReport, SSMError))
    if isinstance(found, GapReport):
        assert found.verdict
        assert str(found)
        assert isinstance(found.tables(), Mapping)
    else:
        assert found.found
        assert len(str(found)) < 3000
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("where", "name", "mode"), [*cases("fast", FEW["fast"]),
                                                     *cases("full", FEW["full"])])  # fmt: skip
def test_a_diagnosis_ends_in_a_report_or_an_error_of_ours(monkeypatch, where, name, mode):
    found = check(monkeypatch, where, name, mode)
    assert isinstance(found, GapReport), found


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("where", "name", "mode"),
    [c for mode in ("fast", "full")
     for c in cases(mode, [m for m in MODELS if m[0] != "features" and m not in FEW[mode]])],
)  # fmt: skip
def test_every_diagnosis_ends_in_a_report_or_an_error_of_ours(monkeypatch, where, name, mode):
    check(monkeypatch, where, name, mode)
