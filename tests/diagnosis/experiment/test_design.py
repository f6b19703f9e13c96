"""The search for the experiment, with made-up ratios in place of simulated ones."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ssmppl.data import bind
from ssmppl.diagnosis.effects.candidate import Candidate
from ssmppl.diagnosis.effects.catalogue_motion import (
    cubic_stiffness,
    level_break,
    quadratic_drag,
    stribeck,
)
from ssmppl.diagnosis.experiment import design
from ssmppl.diagnosis.experiment.design import (
    ALIKE,
    ASTRAY,
    BEHIND,
    CALLED,
    MOST_VARIED,
    OUTSIDE,
    PLAIN,
    separate,
    signals_of,
)
from ssmppl.diagnosis.experiment.rivals import NEEDED, Rival
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.language.tracing import trace
from tests.diagnosis.report.test_tables import model_with
from tests.diagnosis.small import level, levels

ROWS = 60
DRAG, CUBIC, STRIBECK = (
    Rival((Candidate(e, "v"),), {}) for e in (quadratic_drag, cubic_stiffness, stribeck)
)
BREAK = Rival((Candidate(level_break, "v", (("date", 3.0),)),), {})


def records(*inputs):
    """One for each array of inputs (T, U)."""
    out = []
    for u in inputs:
        (e,) = bind(trace(level()), levels(len(u)))
        out.append(replace(e, u=np.ascontiguousarray(u, dtype=float)))
    return out


def driven(count=1, time_step=None):
    """The trace of a model with so many inputs, u0, u1, ..."""
    symbols = [_Symbol("input", f"u{k}", ()) for k in range(count)]
    return SimpleNamespace(input_symbols=symbols, time_step=time_step)


class _Symbol:
    def __init__(self, *data):
        self.data = data

    def __repr__(self):
        return self.data[1]


@pytest.fixture
def looks(monkeypatch):
    """Every look that was taken, as (sets, fitted, inputs, seed), and `answer`, which is asked for
    its ratios (S, R, R) and what else came of it."""
    taken = SimpleNamespace(all=[], answer=lambda e, look, n: {})

    def look_at(augmented, rivals, alternatives, look, seed, k):
        n = len(rivals)
        k, own = divmod(k, n) if look.apart else (k, 0)
        e = alternatives[k]
        if own == 0:  # a look at all truths, be they tasks of their own
            taken.all.append((look.sets, look.fitted, e, tuple(seed.spawn_key), look.within))
        found = taken.answer(e, look, n)
        if isinstance(found, float):  # the same ratio for all pairs
            found = {"ratios": np.where(np.eye(n, dtype=bool), np.nan, np.full((n, n), found))}
            found["ratios"] = np.repeat(found["ratios"][None], look.sets, axis=0)
        ends = {"low": e.y.min(axis=0), "high": e.y.max(axis=0), "inside": np.array(True),
                "left": np.zeros(1, dtype=bool)}  # fmt: skip
        return ends | found

    monkeypatch.setattr(design, "look_at", look_at)
    monkeypatch.setattr(design, "simulators", lambda trace: [])
    return taken


def searched(experiments, rivals=(DRAG, CUBIC), traced=None, members=2):
    traced = driven(experiments[0].u.shape[1]) if traced is None else traced
    seed, checkpoint = np.random.SeedSequence(5), Checkpoint(None, {"mode": "full"})
    return separate(None, traced, rivals, members, experiments, seed, checkpoint)


WANDERING = np.cumsum(np.random.default_rng(1).standard_normal((ROWS, 1)), axis=0)


def is_recorded(e):
    return np.array_equal(e.u, WANDERING)


def by_speed(e, look, n):
    """More nats for what changes more from row to row; the recorded input has one."""
    return 1.5 if is_recorded(e) else float(np.abs(np.diff(e.u[:, 0])).sum())


# -- the search
def test_the_signal_with_the_largest_ratio_is_found_and_put_in_place_of_its_input(looks):
    looks.answer = by_speed
    (e,) = records(WANDERING)
    found = searched([e])
    ratios = [t.nats for t in found.tried if not t.note]
    assert len(ratios) == PLAIN.finalists
    assert ratios == sorted(ratios, reverse=True)
    speeds = [np.abs(np.diff(t.signal.values)).sum() for t in found.tried]
    assert found.best.nats == pytest.approx(max(speeds))
    np.testing.assert_array_equal(found.inputs[:, 0], found.best.signal.values)
    assert (found.runs, found.rows, found.records) == (1, ROWS, 1)
    assert found.recorded == 1.5
    np.testing.assert_array_equal(found.recorded_inputs, WANDERING)
    assert found.effects == (("quadratic drag", "v"), ("cubic stiffness", "v"))


def test_fewer_are_looked_at_more_closely_each_time_with_data_of_their_own(looks):
    looks.answer = by_speed
    found = searched(records(WANDERING))
    steps = {}
    for sets, fitted, _, key, _ in looks.all:
        steps.setdefault((sets, fitted, key), 0)
        steps[sets, fitted, key] += 1
    total = len(found.tried)
    assert [(s, f) for s, f, _ in steps] == [
        (PLAIN.sets, True), (1, False), (1, True), (PLAIN.sets, True)
    ]  # fmt: skip
    assert list(steps.values()) == [1, total, PLAIN.compared, PLAIN.finalists]
    assert len({key for *_, key in steps}) == 4
    still = sum(np.ptp(t.signal.values) == 0.0 for t in found.tried)
    assert sum(t.note == BEHIND for t in found.tried) == total - still - PLAIN.finalists
    assert np.isnan([t.nats for t in found.tried if t.note]).all()


def test_of_one_shape_two_go_on(looks):
    """All sines are best: two of them are fitted to, and others beside them."""
    looks.answer = lambda e, look, n: 1.0 if is_recorded(e) else 9.0
    searched(records(WANDERING))
    compared = [e for sets, fitted, e, *_ in looks.all if (sets, fitted) == (1, True)]
    assert len(compared) == PLAIN.compared
    tried = {t.signal.values.tobytes(): t.signal.shape for t in
             signals_of(driven(), records(WANDERING), ROWS, 1000)}  # fmt: skip
    shapes = [tried[np.ascontiguousarray(e.u[:, 0]).tobytes()] for e in compared]
    assert max(shapes.count(s) for s in shapes) == 2


def test_a_simulator_is_called_less_often(looks, monkeypatch):
    looks.answer = by_speed
    monkeypatch.setattr(design, "simulators", lambda trace: ["one"])
    found = searched(records(WANDERING))
    assert len(found.tried) == CALLED.tried
    assert len({t.signal.shape for t in found.tried}) > 6  # all over the family
    assert max(sets for sets, *_ in looks.all) == CALLED.sets
    assert len(looks.all) == 1 + CALLED.tried + CALLED.compared + CALLED.finalists


def test_where_the_recorded_inputs_do_nothing_else_is_tried(looks):
    looks.answer = lambda e, look, n: NEEDED + 1e-6
    found = searched(records(WANDERING))
    assert found.as_recorded
    assert (len(looks.all), found.tried, found.inputs) == (1, (), None)
    looks.answer = lambda e, look, n: NEEDED - 0.01
    found = searched(records(WANDERING))
    assert not found.as_recorded
    assert found.tried


def test_why_a_signal_has_no_figure(looks):
    """What leaves the range, what fails, and what is alike by its bound, in the first step."""

    def answer(e, look, n):
        u = e.u[:, 0]
        if is_recorded(e):
            return 0.5
        if u.max() == WANDERING.max():
            return {"inside": np.array(False)}
        if u[0] > u.mean():
            return {"ratios": np.full((look.sets, n, n), np.nan)}
        return 0.9 if u.std() < 1.0 else 3.0

    looks.answer = answer
    found = searched(records(WANDERING))
    for t in found.tried:
        u = t.signal.values
        if u.max() == WANDERING.max():
            assert t.note == OUTSIDE
        elif u[0] > u.mean():
            assert t.note == ASTRAY
        else:
            assert t.note == ALIKE if u.std() < 1.0 else t.note in ("", BEHIND)
    assert {t.note for t in found.tried} == {"", OUTSIDE, ASTRAY, ALIKE, BEHIND}
    assert (found.best.nats, found.runs, found.inputs) == (3.0, 0, None)  # of one record, no run


def test_a_ratio_below_zero_is_none(looks):
    looks.answer = lambda e, look, n: -2.0 if look.fitted else 2.0
    found = searched(records(WANDERING))
    assert found.recorded == 0.0
    assert (found.best.nats, found.runs) == (0.0, 0)
    assert found.times_as_many == np.inf


@pytest.mark.parametrize(("nats", "count", "runs"), [
    (5.5, 1, 1), (5.3, 1, 0), (5.3, 2, 2), (2.0, 2, 0), (2.0, 3, 3), (0.9, 30, 0),
])  # fmt: skip
def test_an_experiment_is_run_no_more_often_than_there_are_records(looks, nats, count, runs):
    looks.answer = lambda e, look, n: 0.1 if is_recorded(e) else nats if look.fitted else 9.0
    found = searched(records(WANDERING, *[WANDERING[:20]] * (count - 1)))
    assert found.runs == runs
    assert (found.inputs is not None) == (runs > 0)


def test_how_many_records_would_do(looks):
    looks.answer = lambda e, look, n: 2.0
    assert searched(records(WANDERING)).times_as_many == pytest.approx(NEEDED / 2.0)
    assert pytest.approx(2 * 1.645**2, abs=0.02) == NEEDED


# -- what counts
def test_the_hardest_pair_counts_and_sets_are_averaged(looks):
    ratios = np.array([
        [[np.nan, 4.0, 9.0], [8.0, np.nan, 9.0], [9.0, 9.0, np.nan]],
        [[np.nan, 2.0, 9.0], [3.0, np.nan, 9.0], [9.0, 9.0, np.nan]],
    ])  # fmt: skip
    looks.answer = lambda e, look, n: {"ratios": ratios}
    found = searched(records(WANDERING), (DRAG, CUBIC, STRIBECK, BREAK), members=6)
    assert found.recorded == 3.0  # mean of 4 and 2
    assert len(found.effects) == 3  # the leading ones
    assert found.members == 6
    ratios[0, 0, 1] = np.nan
    looks.answer = lambda e, look, n: {"ratios": ratios}
    assert searched(records(WANDERING), (DRAG, CUBIC, STRIBECK)) is None  # half of them failed
    third = np.concatenate([ratios, ratios[1:]])
    looks.answer = lambda e, look, n: {"ratios": third}
    assert searched(records(WANDERING), (DRAG, CUBIC, STRIBECK)).recorded == 2.0


def test_what_happens_once_is_a_rival_and_no_truth(looks):
    """In another record it does not happen again: only the other way round is it told."""
    ratios = np.array([[[np.nan, np.nan], [7.0, np.nan]]])
    looks.answer = lambda e, look, n: {"ratios": ratios}
    assert searched(records(WANDERING), (BREAK, DRAG)).recorded == 7.0
    assert searched(records(WANDERING), (BREAK, BREAK)) is None


def test_a_fault_of_the_recorded_inputs_ends_the_search(looks):
    def fails(e, look, n):
        raise ZeroDivisionError("no such thing")

    looks.answer = fails
    assert searched(records(WANDERING)) is None


def test_outputs_may_leave_their_recorded_range_by_a_tenth(looks):
    """By all records and by what the rivals do under the recorded inputs."""
    (long, short) = records(WANDERING, WANDERING[:20])
    long.y[:, 0], short.y[:, 0] = np.linspace(0.0, 1.0, ROWS), 5.0
    ends = {"low": np.array([-5.0]), "high": np.array([2.0])}
    looks.answer = lambda e, look, n: {"ratios": np.full((1, n, n), 3.0), **ends}
    searched([long, short])
    within = [w for *_, w in looks.all]
    assert within[0] is None
    for low, high in within[1:]:
        np.testing.assert_allclose([low, high], [[-6.0], [6.0]])


# -- which inputs
def test_each_input_that_varies_is_varied_by_itself(looks):
    rng = np.random.default_rng(3)
    u = np.column_stack([np.full(ROWS, 0.1), rng.standard_normal((ROWS, 2))])
    looks.answer = lambda e, look, n: (
        1.5 if np.array_equal(e.u, u) else 9.0 * float(e.u[:, 2].std())
    )
    found = searched(records(u), traced=driven(3))
    assert {t.input for t in found.tried} == {"u1", "u2"}
    for *_, e, _, _ in looks.all[1:]:
        changed = np.any(e.u != u, axis=0)
        assert changed.sum() == 1
        assert not changed[0]
    assert found.best.input == "u2"
    np.testing.assert_array_equal(found.inputs[:, :2], u[:, :2])
    np.testing.assert_array_equal(found.inputs[:, 2], found.best.signal.values)


def test_the_length_of_a_step_is_no_input_to_vary():
    u = np.random.default_rng(4).standard_normal((ROWS, 2))
    traced = driven(2, time_step=("u0", "s"))
    assert {t.input for t in signals_of(traced, records(u), ROWS, 1000)} == {"u1"}


def test_an_input_that_is_a_setting_of_each_record_stays(looks):
    looks.answer = lambda e, look, n: 1.0
    found = searched(records(np.zeros((ROWS, 1)), np.ones((30, 1))))
    assert (found.tried, found.inputs, found.rows) == ((), None, ROWS)
    nothing = searched(records(np.empty((ROWS, 0))), traced=driven(0))
    assert (nothing.tried, nothing.recorded) == ((), 1.0)


def test_of_many_inputs_a_few_are_varied():
    u = np.random.default_rng(5).standard_normal((ROWS, 9))
    names = {t.input for t in signals_of(driven(9), records(u), ROWS, 3)}
    assert names == {f"u{k}" for k in range(MOST_VARIED)}
    assert len(list(signals_of(driven(9), records(u), ROWS, 3))) == 3 * MOST_VARIED


def test_inputs_go_by_their_components():
    traced = trace(model_with({"u": 2}))
    u = np.random.default_rng(6).standard_normal((ROWS, 2))
    assert {t.input for t in signals_of(traced, records(u), ROWS, 2)} == {"u[0]", "u[1]"}
