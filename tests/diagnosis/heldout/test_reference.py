"""The reference: what it does with fits that go astray."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.fitting.fit import FROM_START, Fitter
from ssmppl.diagnosis.heldout import gain_ratio, reference
from ssmppl.diagnosis.heldout.reference import Residual
from ssmppl.diagnosis.model.smoothing import Settings
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.errors import SamplingError
from ssmppl.inference.run.seeds import seed_sequence
from tests.diagnosis.model.test_basis import THETA, asked, simulated

FIXED = {n: np.asarray(v) for n, v in THETA.items() if n != "phi"}


WITHOUT, FAILS = "", None


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({WITHOUT: 1.0, "a": 2.0, "b": 0.0, "c": 0.0, "ab": 3.0, "abc": 4.0}, "abc"),
        ({WITHOUT: 1.0, "a": 2.0, "b": 5.0, "c": 3.0, "ab": 1.5, "ac": 2.5}, "ac"),
        ({WITHOUT: 1.0, "a": 0.5, "b": 2.0, "c": 4.0, "bc": 1.5}, "b"),
        ({WITHOUT: 1.0, "a": FAILS, "b": 0.5, "c": 9.0}, "c"),
        ({WITHOUT: 1.0, "a": 0.5, "b": 0.6, "c": 1.0}, ""),
        ({WITHOUT: FAILS, "a": 0.5, "b": 0.6, "c": 1.0}, ""),
    ],
)
def test_groups_are_taken_in_where_each_predicts_other_rows_better(monkeypatch, values, expected):
    """One after the other, the first of them first; one that does not help bars no other."""

    def fit(names):
        if values[names] is FAILS:
            raise SamplingError("it has no fit", fix="none")
        return values[names]

    monkeypatch.setattr(
        reference, "superset",
        lambda augmented, chosen, start, groups: ("".join(terms for terms, _ in groups), {}),
    )  # fmt: skip
    monkeypatch.setattr(reference, "predicted_later", lambda names, *_: fit(names))
    groups = [(name, 1.0) for name in "abc"]
    kept = reference._worth(None, (), None, groups, object(), None, Checkpoint(None, {}))
    assert "".join(name for name, _ in kept) == expected


def test_groups_come_by_how_far_they_stand_out(monkeypatch):
    """Of few functions each may say more, and the group less."""
    terms = [SimpleNamespace(equation="v", moment="mean", variable=v) for v in ("x", "u")]
    nothing = SimpleNamespace(nuisance=np.zeros((5, 0)), basis=np.zeros((5, 2)))
    seen = SimpleNamespace(nuisance=np.zeros(0), basis=np.zeros(2))
    screen = SimpleNamespace(
        design=SimpleNamespace(terms=terms), simulated=nothing, observed=seen,
        columns_of=lambda _: (np.zeros((5, 0)), np.zeros(0)),
    )  # fmt: skip
    found = SimpleNamespace(status=["", ""], z=np.array([3.0, 5.0]), variance=np.ones(2))
    groups = {("v", "mean", v): Residual(z, 0.01) for v, z in (("x", 9.0), ("u", 4.0))}
    monkeypatch.setattr(reference.Null, "of", lambda *_: None)
    monkeypatch.setattr(reference, "efficient", lambda *_: found)
    monkeypatch.setattr(reference, "residual_groups", lambda *_: groups)
    made = reference.significant_groups(screen, ())
    assert [t[0].variable for t, _ in made] == ["x", "u"]


@pytest.mark.parametrize("chosen", [True, False])
@pytest.mark.parametrize("curves", [True, False])
def test_it_is_told_whether_the_reference_has_curves(monkeypatch, chosen, curves):
    def stop(*_, **__):
        raise SamplingError("enough", fix="none")

    base, effect, more = object(), object(), object()
    own = SimpleNamespace(candidates=(), fit=effect, fitter=None, simulator=(None, effect))
    plain = effect if chosen else base
    monkeypatch.setattr(gain_ratio, "free_run", lambda *_: None)
    monkeypatch.setattr(
        gain_ratio, "fit_reference", lambda *_: (None, more if curves else plain)
    )  # fmt: skip
    monkeypatch.setattr(
        gain_ratio, "predict", lambda *_: SimpleNamespace(log_density=None, starts=(0,))
    )
    monkeypatch.setattr(gain_ratio, "gain_ratio", stop)
    split = SimpleNamespace(experiments=(), held_out=(), train=())
    rows = gain_ratio.HeldOutRows(
        None, split, (None, base), None, own if chosen else None, None, (None, base)
    )
    assert rows.gain("curves", None, Checkpoint(None, {})).curves == curves


def test_without_curves_it_is_the_model_itself_as_it_was_fitted(monkeypatch):
    """And not a further fit of it, which would pass for one with curves."""
    monkeypatch.setattr(reference, "significant_groups", lambda *_: [([], 1.0)])
    monkeypatch.setattr(reference, "_worth", lambda *_: [])
    chosen, start, own = ("drag",), object(), object()
    augmented = SimpleNamespace(fitter=lambda c: own if c == chosen else None)
    found = reference.fit_reference(
        augmented, chosen, start, None, (), None, Checkpoint(None, {}), split=object()
    )
    assert found[0] is own
    assert found[1] is start


@pytest.mark.slow
def test_a_fit_below_where_it_started_is_not_used(monkeypatch):
    screen = asked(simulated(lambda x, w, u: 0.15 * x * u, "x and u"))
    trace, missing = screen.design.trace, screen.design.smoother.missing
    augmented = AugmentedModels(trace, missing, FIXED, Settings(particles=100))
    start = {n: np.asarray(v) for n, v in THETA.items()}
    base = augmented.base_fitter
    train = list(screen.experiments)
    fit = base.fit(train, seed_sequence(1), start, FROM_START)
    groups = reference.significant_groups(screen, ())
    assert groups

    def made():
        return reference.fit_reference(
            augmented, (), fit, screen, train, seed_sequence(2), Checkpoint(None, {})
        )

    fitter, found = made()
    assert fitter is not base
    assert found.log_likelihood > fit.log_likelihood + 2.0
    fitted = Fitter.fit

    def astray(self, *args, **kwargs):
        out = fitted(self, *args, **kwargs)
        return replace(out, log_likelihood=out.log_likelihood - 1e4)

    monkeypatch.setattr(Fitter, "fit", astray)
    fitter, found = made()
    assert fitter is base
    assert found is fit


@pytest.mark.parametrize(
    ("groups", "expected"),
    [
        ([("mean", 3), ("mean", 2)], 9.0 - 3.0),  # of the first group alone, one for each function
        ([("scale", 3), ("mean", 2)], 0.0),
        ([], 0.0),
    ],
)
def test_curves_in_place_of_effects_gain_what_the_fit_does_less_their_number(
    monkeypatch, groups, expected
):
    made = [([SimpleNamespace(moment=m)] * n, 1.0) for m, n in groups]
    seen = []
    monkeypatch.setattr(
        reference, "significant_groups", lambda _, chosen: seen.append(chosen) or made
    )

    class Own:
        fit = staticmethod(lambda *_: SimpleNamespace(numbers={"ll": np.asarray(-91.0)}))
        restored = staticmethod(lambda _, n: SimpleNamespace(log_likelihood=float(n["ll"])))

    def superset(augmented, chosen, start, groups):
        assert (chosen, start, groups) == ((), base, made[:1])
        return Own, {}

    monkeypatch.setattr(reference, "superset", superset)
    base = SimpleNamespace(log_likelihood=-100.0)
    found = reference.gain_of_curves(None, base, ("drag",), None, (), None, Checkpoint(None, {}))
    assert found == expected
    assert seen == [("drag",)]  # what stands out beside it
