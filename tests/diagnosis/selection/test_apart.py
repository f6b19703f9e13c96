"""Other inputs that are tried: one of them replaced at a time, in its own units."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ssmppl.data import bind
from ssmppl.diagnosis.selection.equivalence import (
    LEVELS,
    MOST_VARIED,
    best_separating_input,
    simple_inputs,
)
from ssmppl.language.tracing import trace
from tests.diagnosis.small import level, levels

T = 80


def experiments(*inputs):
    """One for each array of inputs (T, L)."""
    (e,) = bind(trace(level()), levels(T))
    return [replace(e, u=np.ascontiguousarray(u, dtype=float)) for u in inputs]


def test_one_input_at_a_time_and_none_that_is_constant():
    """With u and dt, the drive is varied and the length of a step is not."""
    rng = np.random.default_rng(3)
    dt, drive = np.full((T, 1), 0.1), rng.standard_normal((T, 2)) + 2.0
    u = np.concatenate([dt, drive], axis=1)
    found = simple_inputs(experiments(u), ["dt", "u[0]", "u[1]"])
    assert len(found) == 10
    for name, (e,) in found.items():
        assert ("u[0]" in name) != ("u[1]" in name)
        own = 1 if "u[0]" in name else 2
        rest = [k for k in range(3) if k != own]
        np.testing.assert_array_equal(e.u[:, rest], u[:, rest])
        assert not np.array_equal(e.u[:, own], u[:, own])
        assert e.u.flags.c_contiguous
    (twice,) = found["the same u[1] at twice the size"]
    np.testing.assert_array_equal(twice.u[:, 2], 2.0 * u[:, 2])
    (slow,) = found["a slow sine of u[0]"]  # four whole periods, of the same mean and spread
    assert slow.u[:, 1].mean() == pytest.approx(u[:, 1].mean())
    assert slow.u[:, 1].std() == pytest.approx(u[:, 1].std())
    (stair,) = found["a staircase of u[0] over the same range"]
    ends = u[:, 1].min(), u[:, 1].max()
    np.testing.assert_allclose(np.unique(stair.u[:, 1]), np.linspace(*ends, LEVELS))


def test_an_input_that_is_constant_in_one_experiment_stays_there():
    moving, still = np.arange(T)[:, None], np.ones((T, 1))
    for first, second in simple_inputs(experiments(moving, still), ["u"]).values():
        assert not np.array_equal(first.u, moving)
        np.testing.assert_array_equal(second.u, still)


def test_of_many_inputs_a_few_are_tried():
    many = np.random.default_rng(4).standard_normal((T, 9))
    assert len(simple_inputs(experiments(many), list("abcdefghi"))) == 5 * MOST_VARIED


def test_where_nothing_varies_no_input_is_named():
    design = SimpleNamespace(trace=SimpleNamespace(input_symbols=["dt"]))
    screen = SimpleNamespace(design=design, experiments=experiments(np.ones((T, 1))))
    assert best_separating_input(screen, [0, 1], np.random.SeedSequence(1), None) == ""
