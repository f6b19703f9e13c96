"""Distributions as they are printed."""

import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.expressions.expr import symbol

A, B = (symbol("parameter", n) for n in "ab")


@pytest.mark.parametrize(
    ("law", "text"),
    [
        (lambda: ssm.Normal(np.zeros(3), sd=A), "Normal(mean=0, sd=a)"),
        (lambda: ssm.Normal([A, B, 0.0], sd=1), "Normal(mean=[a, b, 0], sd=1)"),
        (lambda: ssm.Normal([A, 0, 0, 0, 0, B], sd=1), "Normal(mean=[a, 0 (4 times), b], sd=1)"),
        (lambda: ssm.MvNormal([A, B], covariance=np.eye(2)),
         "MvNormal(mean=[a, b], covariance=diag([1, 1]))"),
        (lambda: ssm.MvNormal(np.zeros(6), covariance=np.diag(np.stack([A, B, *np.zeros(4)]))),
         "MvNormal(mean=0, covariance=diag([a, b, 0 (4 times)]))"),
        (lambda: ssm.MvNormal([0, 0], covariance=[[A, 0.5], [0.5, B]]),
         "MvNormal(mean=0, covariance=[[a, 0.5], [0.5, b]])"),
        (lambda: ssm.Normal(np.block([[A, 0], [0, B], [0, 0]]), sd=1),
         "Normal(mean=[[a, 0], [0, b], [0, 0]], sd=1)"),
    ],
)  # fmt: skip
def test_arrays_are_short(law, text):
    assert repr(law()) == text
