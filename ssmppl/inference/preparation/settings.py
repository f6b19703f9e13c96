"""What the settings of methods may be, each refused by its name before anything is traced.

What depends on the model is refused where it is known: names of parameters and proposals, the shape
of a covariance, what does not apply.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ssmppl.counts import check_count, check_number
from ssmppl.errors import ArgumentError, listing
from ssmppl.inference.methods.methods import (
    EM,
    IF2,
    PGAS,
    PMMH,
    PSAEM,
    SMC2,
    DirectOptimization,
    FFBSi,
    FixedLag,
    ForwardBackward,
    Gibbs,
    KalmanSmoother,
    MetropolisHastings,
    ParticleEM,
    ScoreAscent,
)
from ssmppl.inference.particles.filtering import check_rescue

Rule = Callable[[str, Any], None]

STEPS = ("newton", "paper")  # of ScoreAscent
POSITIVE = "give a positive number"
SHARE = "give a share, from 0 to 1"
RATE = "give a rate of acceptance, between 0 and 1"


def check_settings(method: Any) -> None:
    """Refuse settings that no model could go with; objects that are no method pass.

    Raises
    ------
    ArgumentError : names the setting, its value and what it may be.
    """
    for name, rule in RULES.get(type(method), {}).items():
        rule(name, getattr(method, name))
    for together in TOGETHER.get(type(method), ()):
        together(method)


def _count(least: int) -> Rule:
    return lambda name, value: check_count(name, value, least)


def _or_none(rule: Rule) -> Rule:
    return lambda name, value: None if value is None else rule(name, value)


def _number(fits: Callable[[float], bool], fix: str) -> Rule:
    return lambda name, value: check_number(name, value, fits, fix)


def _flag(name: str, value: Any) -> None:
    if not isinstance(value, (bool, np.bool_)):
        raise ArgumentError(f"{name}={value!r}", fix="give True or False")


def _name(name: str, value: Any) -> None:
    """Which names there are depends on the model, or is told where it is looked up."""
    if not isinstance(value, str):
        raise ArgumentError(f"{name}={value!r}", fix='give a name, as "auto"')


def _one_of(valid: Sequence[str]) -> Rule:
    def rule(name: str, value: Any) -> None:
        if not isinstance(value, str) or value not in valid:
            fix = f"use one of: {listing(str(value), valid)}"
            raise ArgumentError(f"{name}={value!r}", fix=fix)

    return rule


def _order(most: int, fix: str) -> Rule:
    def rule(name: str, value: Any) -> None:
        check_number(name, value, lambda v: v in range(most + 1), fix)

    return rule


def _rescue(name: str, value: Any) -> None:
    check_rescue(value)


def _covariance(name: str, value: Any) -> None:
    """Its shape and definiteness are looked at once the parameters are known."""
    try:
        finite = bool(np.all(np.isfinite(np.asarray(value, dtype=float))))
    except (TypeError, ValueError):
        finite = False
    if not finite:
        raise ArgumentError(f"{name}={value!r}", fix="give a matrix of finite numbers, or None")


def _transform(name: str, value: Any) -> None:
    pairs = list(value.items()) if isinstance(value, Mapping) else [(None, None)]
    if not all(isinstance(k, str) and isinstance(v, str) for k, v in pairs):
        raise ArgumentError(
            f"{name}={value!r}",
            fix='give scales by the names of parameters, as {"tau": "reciprocal"}, or None',
        )


def _interweave(name: str, value: Any) -> None:
    if not (isinstance(value, bool) or (isinstance(value, str) and value == "auto")):
        raise ArgumentError(f"{name}={value!r}", fix='use "auto", True or False')


def _eliminate(name: str, value: Any) -> None:
    named = isinstance(value, (tuple, list)) and all(isinstance(n, str) for n in value)
    known = isinstance(value, str) and value == "auto"
    if not (named or known or isinstance(value, bool)):
        fix = 'use "auto", True, False or a tuple of parameters\' names'
        raise ArgumentError(f"{name}={value!r}", fix=fix)


def _perturbation(name: str, value: Any) -> None:
    for number in value.values() if isinstance(value, Mapping) else [value]:
        try:
            check_number(name, number, lambda v: v > 0.0, "")
        except ArgumentError:
            raise ArgumentError(
                f"{name}={value!r}",
                fix="give positive numbers, standard deviations on the unconstrained scale; hold "
                "a parameter still by fixed={...}",
            ) from None


def _starts(name: str, value: Any) -> None:
    if not isinstance(value, Sequence) or isinstance(value, str):
        check_count(name, value, 1)
    elif not len(value):
        raise ArgumentError(f"{name} is empty", fix="give a number, or one mapping for each")
    elif not all(isinstance(v, Mapping) for v in value):
        fix = "give a number, or a list of mappings from names of parameters to values"
        raise ArgumentError(f"{name}={value!r}", fix=fix)


def _beyond_burn_in(method: ParticleEM | PSAEM) -> None:
    check_count("iterations", method.iterations, method.burn_in + 1)


def _several_runs(method: ScoreAscent) -> None:
    if method.steps != "paper" and method.runs is not None:
        check_count("runs", method.runs, 2)  # whose spread is the noise of the score


def _one_filter(method: PMMH) -> None:
    """The filters of some settings exclude those of others."""
    if method.rescue and (method.order or method.correlation):
        raise ArgumentError(
            f"rescue={method.rescue} together with order={method.order}, correlation="
            f"{method.correlation}: the filters of these draw a fixed number of particles",
            fix="use ssm.PMMH(rescue=...) with order=0 and correlation=0.0",
        )
    if method.rescue and method.proposal == "tempered":
        raise ArgumentError(
            f'rescue={method.rescue} together with proposal="tempered"', fix="use one of them"
        )
    if method.order and method.correlation:
        raise ArgumentError(
            f"order={method.order} together with correlation={method.correlation}",
            fix="use one of them: the sorted filter of the correlated method keeps no scores",
        )


WALK: dict[str, Rule] = {
    "target_acceptance": _or_none(_number(lambda v: 0.0 < v < 1.0, RATE)),
    "covariance": _or_none(_covariance),
    "scale": _name,
    "transform": _or_none(_transform),
    "adapt": _or_none(_flag),
}
FILTER: dict[str, Rule] = {
    "proposal": _name,
    "resampling": _name,
    "ess_threshold": _number(
        lambda v: 0.0 <= v <= 1.0, "give a number from 0 (never resample) to 1 (always)"
    ),
}
RULES: dict[type, dict[str, Rule]] = {
    MetropolisHastings: WALK
    | {
        "order": _or_none(_order(1, "use 0 (random walk), 1 (Langevin, by the gradient) or None")),
    },
    Gibbs: {"interweave": _interweave},
    PMMH: WALK
    | {
        "particles": _or_none(_count(1)),
        "proposal": _name,
        "target_sd": _number(lambda v: v > 0.0, POSITIVE),
        "order": _order(2, "use 0 (random walk), 1 (gradient) or 2 (gradient and information)"),
        "lag": _count(0),
        "correlation": _number(
            lambda v: 0.0 <= v < 1.0,
            "give a number from 0 (fresh random numbers) to below 1, as 0.99",
        ),
        "rescue": _rescue,
    },
    PGAS: {
        "particles": _or_none(_count(2)),
        "proposal": _name,
        "log_likelihood": _flag,
        "interweave": _interweave,
        "eliminate": _eliminate,
    },
    SMC2: {
        "parameters": _or_none(_count(2)),
        "particles": _count(1),
        "ess_threshold": _number(lambda v: 0.0 <= v <= 1.0, SHARE),
        "moves": _count(1),
        "acceptance": _number(lambda v: 0.0 <= v <= 1.0, SHARE),
        "proposal": _name,
    },
    DirectOptimization: {
        "particles": _count(2),
        "averages": _count(2),
        "restarts": _or_none(_count(0)),
        "steps": _count(1),
    },
    EM: {
        "iterations": _count(1),
        "tolerance": _number(lambda v: v > 0.0, POSITIVE),
        "accelerate": _flag,
    },
    ParticleEM: {
        "particles": _count(2),
        "runs": _count(1),
        "trajectories": _count(1),
        "proposal": _name,
        "kernel": _name,
        "iterations": _count(1),
        "burn_in": _count(0),
        "chains": _count(1),
    },
    PSAEM: {
        "particles": _or_none(_count(2)),
        "proposal": _name,
        "iterations": _count(1),
        "burn_in": _count(1),
        "exponent": _number(lambda v: 0.5 < v <= 1.0, "give a number above 0.5 and at most 1"),
        "chains": _count(1),
    },
    ScoreAscent: {
        "steps": _one_of(STEPS),
        "particles": _or_none(_count(1)),
        "trajectories": _or_none(_count(1)),
        "runs": _or_none(_count(1)),
        "iterations": _or_none(_count(1)),
        "tolerance": _number(lambda v: v > 0.0, POSITIVE),
        "gamma": _number(lambda v: v > 0.0, POSITIVE),
        "exponent": _number(lambda v: v <= 0.0, "give a number of at most 0, as -2/3"),
        "proposal": _name,
        "kernel": _name,
    },
    IF2: {
        "particles": _count(2),
        "iterations": _count(1),
        "cooling": _number(
            lambda v: 0.0 < v <= 1.0,
            "give what is left of the steps after 50 iterations: above 0, at most 1",
        ),
        "perturbation": _perturbation,
        "starts": _starts,
        "averaged": _count(1),
        "evaluations": _count(2),
        "points": _or_none(_count(0)),
    },
    KalmanSmoother: {},
    ForwardBackward: {},
    FFBSi: FILTER | {"kernel": _name, "moves": _count(0), "rescue": _rescue},
    FixedLag: FILTER | {"lag": _or_none(_count(0))},
}
TOGETHER: dict[type, tuple[Callable[[Any], None], ...]] = {
    PMMH: (_one_filter,),
    ParticleEM: (_beyond_burn_in,),
    PSAEM: (_beyond_burn_in,),
    ScoreAscent: (_several_runs,),
}
