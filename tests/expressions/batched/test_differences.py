"""Derivatives of a function that takes a batch, against those on paper."""

from contextlib import nullcontext

import numpy as np
import pytest

from ssmppl.errors import SamplingError
from ssmppl.expressions.batched.call import MOST_AT_ONCE, computed, gathered, thriftily
from ssmppl.expressions.batched.differences import FIRST, ONE_SIDED, SECOND, Stencil

X = np.array([[0.3, -1.2], [2.0, 0.0], [-0.7, 40.0]])
WANTED = [(), (0,), (1,), (0, 0), (0, 1), (1, 1)]


def function(p):
    x, y = p.T
    return np.stack([np.sin(x) * y**2, np.exp(0.1 * x * y)], axis=1)


def exact(p):
    x, y = p.T
    e = np.exp(0.1 * x * y)
    return {
        (): (np.sin(x) * y**2, e),
        (0,): (np.cos(x) * y**2, 0.1 * y * e),
        (1,): (2 * np.sin(x) * y, 0.1 * x * e),
        (0, 0): (-np.sin(x) * y**2, 0.01 * y**2 * e),
        (0, 1): (2 * np.cos(x) * y, (0.1 + 0.01 * x * y) * e),
        (1, 1): (2 * np.sin(x), 0.01 * x**2 * e),
    }


@pytest.mark.parametrize("index", WANTED)
def test_against_those_on_paper(index):
    """Errors: truncation h^2 f''' / 6 and rounding eps f / h of first, h^2 f'''' / 6 and 4 eps f /
    h^2 of second differences, with f and its derivatives below 2,000 here, and h / max(|x|, 1)
    `FIRST` or `SECOND`."""
    found = Stencil.of(WANTED, 2).derivatives(function, X, np.ones(2))[WANTED.index(index)]
    known = np.stack(exact(X)[index])
    size = np.abs(np.stack(exact(X)[()])).max(axis=0) + 1.0
    eps = np.finfo(float).eps
    error = [0.0, 4 * eps / FIRST + 50 * FIRST**2, 16 * eps / SECOND**2 + 50 * SECOND**2]
    assert np.all(np.abs(found - known) <= error[len(index)] * size * 4 + 1e-300)


FEW = {  # what is wanted: how many points it takes
    "slopes": ([(), (0,), (1,)], 3),  # the point itself and one of each
    "one bent": ([(0,), (1,), (1, 1)], 4),  # and two of what is bent
    "all bent": (WANTED, 7),  # and two of the mixed one
}


@pytest.mark.parametrize("name", FEW)
def test_few_points_give_half_the_digits(name):
    """One-sided: truncation h f'' / 2 and rounding 2 eps f / h; with the points of the second
    derivative h^2 / 6 times the third one."""
    asked, (wanted, number) = [], FEW[name]

    def counted(p):
        asked.append(len(p))
        return function(p)

    found = Stencil.of(wanted, 2, few=True).derivatives(counted, X, np.ones(2))
    assert asked == [len(X) * number]
    size = np.abs(np.stack(exact(X)[()])).max(axis=0) + 1.0
    eps = np.finfo(float).eps
    first = max(2 * eps / ONE_SIDED + 50 * ONE_SIDED, 4 * eps / SECOND + 50 * SECOND**2)
    error = [0.0, first, 16 * eps / SECOND**2 + 50 * SECOND**2]
    for row, index in zip(found, wanted, strict=True):
        known = np.stack(exact(X)[index])
        assert np.all(np.abs(row - known) <= error[len(index)] * size * 4 + 1e-300)


def test_one_call_for_all_of_them():
    calls = []

    def counted(p):
        calls.append(len(p))
        return function(p)

    Stencil.of(WANTED, 2).derivatives(counted, X, np.ones(2))
    # the point itself, two of each first, two of each second, two of the mixed one
    assert calls == [len(X) * (1 + 4 + 4 + 2)]


def test_on_one_side_where_the_other_has_no_value():
    def root(p):
        with np.errstate(invalid="ignore"):
            return np.sqrt(p)

    stencil = Stencil.of([(), (0,)], 1)
    found = stencil.derivatives(lambda p: root(p) ** 2, np.zeros((1, 1)), np.ones(1))
    assert found[1, 0, 0] == pytest.approx(1.0)


def test_steps_go_by_the_scale():
    """sin(x / 1e-6) at 0 has the slope 1e6; with steps of 6e-6 nothing of it is seen."""
    stencil = Stencil.of([(0,)], 1)
    x = np.zeros((1, 1))
    slope = stencil.derivatives(lambda p: np.sin(p / 1e-6), x, np.array([1e-6]))
    assert slope[0, 0, 0] == pytest.approx(1e6, rel=1e-9)
    coarse = stencil.derivatives(lambda p: np.sin(p / 1e-6), x, np.array([1.0]))
    assert abs(coarse[0, 0, 0] - 1e6) > 1e5


class Root:
    """A function with a value on one side of zero only."""

    name, scales = "root", np.ones(1)

    def at(self, points):
        with np.errstate(invalid="ignore"):
            return np.sqrt(-points)


def test_few_points_take_the_other_side_at_the_end_of_a_range():
    x = np.array([[-1e-9], [-0.5]])
    with thriftily():
        value, slope = computed(Root(), ((), (0,)), x)
    np.testing.assert_allclose(value[0], np.sqrt(-x[:, 0]))
    assert np.isfinite(slope).all()
    assert slope[0, 1] == pytest.approx(-0.5 / np.sqrt(0.5), rel=1e-6)


def test_central_differences_come_back_afterwards():
    asked = []

    class Counted(Root):
        def at(self, points):
            asked.append(len(points))
            return super().at(points)

    for within in (False, True, False):
        with thriftily() if within else nullcontext():
            computed(Counted(), ((), (0,)), np.array([[-0.5]]))
    assert asked == [3, 2, 3]


class Cubed:
    """x^3, and the points that it is asked for."""

    name, scales, outputs = "cubed", np.ones(1), 1

    def __init__(self):
        self.asked = []

    def at(self, points):
        self.asked.append(len(points))
        return points**3


def test_draws_round_one_point_share_its_derivatives():
    x, function = np.array([[0.9], [1.0], [1.1], [1.2]]), Cubed()
    middle = x.mean()
    with thriftily(alike=True):
        value, slope = computed(function, ((), (0,)), x)
        np.testing.assert_allclose(value[0], x[:, 0] ** 3)
        np.testing.assert_allclose(slope[0], 3.0 * middle**2, rtol=1e-6)
        assert sum(function.asked) == 4 + 2
        again, bend = computed(function, ((), (0, 0)), x)  # the values are known by now
        assert sum(function.asked) == 4 + 2 + 2
        np.testing.assert_array_equal(again, value)
        np.testing.assert_allclose(bend[0], 6.0 * middle, rtol=1e-3)
        slope = computed(function, ((0,),), x[:1])[0]  # a point alone has its own
        assert slope[0] == pytest.approx(3.0 * 0.9**2, rel=1e-6)
    slope = computed(function, ((0,),), x)[0]
    np.testing.assert_allclose(slope[0], 3.0 * x[:, 0] ** 2, rtol=1e-6)


def test_each_has_its_own_where_there_is_none_in_the_middle():
    class Gap(Cubed):
        def at(self, points):
            return np.where(np.abs(points) < 0.5, np.nan, points**3)

    x = np.array([[-1.0], [1.1]])
    with thriftily(alike=True):
        slope = computed(Gap(), ((0,),), x)[0]
    np.testing.assert_allclose(slope[0], 3.0 * x[:, 0] ** 2, rtol=1e-6)


def test_within_another_thrifty_part_the_outer_one_goes_on():
    x, function = np.array([[0.9], [1.1]]), Cubed()
    with thriftily(alike=True):
        with thriftily():
            slope = computed(function, ((0,),), x)[0]
            np.testing.assert_allclose(slope[0], 3.0 * x[:, 0] ** 2, rtol=1e-6)
        slope = computed(function, ((0,),), x)[0]
        np.testing.assert_allclose(slope[0], 3.0, rtol=1e-6)


def passed(function, points):
    """What a pass over rows asks for: values and derivatives of one, then others at the same."""
    found = []
    for wanted in (((), (0,)), ((), (0, 0), (0,)), ((0,),)):
        found += [computed(function, wanted, x) for x in points]
    return found


def test_calls_that_are_gathered_are_made_together_and_give_the_same():
    points = [np.linspace(a, a + 0.3, 4)[:, None] for a in np.linspace(0.5, 3.0, 200)]
    plain, function = Cubed(), Cubed()
    with thriftily(alike=True):
        expected = passed(plain, points)
    with thriftily(alike=True):
        with gathered():
            blank = passed(function, points)
        assert not any(b.any() for b in blank)
        assert [b.shape for b in blank] == [e.shape for e in expected]
        before = len(function.asked)
        found = passed(function, points)
        assert len(function.asked) == before  # all was there
    assert before < 10 < len(plain.asked)
    assert max(function.asked) <= MOST_AT_ONCE
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-4)  # first ones beside second ones: other steps
    with thriftily(alike=True):  # and of derivatives that are asked for alike, the very same
        expected = [computed(plain, ((), (0,)), x) for x in points]
    with thriftily(alike=True):
        with gathered():
            [computed(function, ((), (0,)), x) for x in points]
        found = [computed(function, ((), (0,)), x) for x in points]
    np.testing.assert_array_equal(found, expected)


def test_what_comes_to_no_number_or_raises_together_is_asked_for_alone():
    class Gap(Cubed):
        def at(self, points):
            super().at(points)
            if len(points) > 20:
                raise SamplingError("too many", fix="fewer")
            return np.where(np.abs(points) < 0.5, np.nan, points**3)

    few = [np.array([[-1.0], [1.1]]), np.array([[0.9], [1.1]])]
    for points in (few, [np.array([[a], [a + 0.1]]) for a in np.linspace(1.0, 2.0, 30)]):
        with thriftily(alike=True):
            with gathered():
                [computed(Gap(), ((0,),), x) for x in points]
            found = [computed(Gap(), ((0,),), x)[0] for x in points]
        for x, slope in zip(points, found, strict=True):
            middle = x if abs(x.mean()) < 0.5 else np.full_like(x, x.mean())
            np.testing.assert_allclose(slope[0], 3.0 * middle[:, 0] ** 2, rtol=1e-6)
