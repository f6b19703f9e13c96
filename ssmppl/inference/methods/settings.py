"""What the settings of methods may be, each refused by its name before anything is traced.

A setting is a field of a method's dataclass, declared with its rule: `steps: int = setting(200,
count(1))`. A method whose settings exclude each other has `_check_together`. What depends on the
model is refused where it is known: names of parameters and proposals, the shape of a covariance,
what does not apply.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, fields, is_dataclass
from typing import Any

import numpy as np

from ssmppl.counts import check_count, check_number
from ssmppl.errors import ArgumentError, listing

Rule = Callable[[str, Any], None]

POSITIVE = "give a positive number"
SHARE = "give a share, from 0 to 1"
RATE = "give a rate of acceptance, between 0 and 1"


def setting(default: Any, rule: Rule) -> Any:
    """A field of a method's dataclass: its default, and what refuses other values."""
    return field(default=default, metadata={"rule": rule})


def rules_of(method: Any) -> dict[str, Rule]:
    """The rule of each setting of a method, an object or its class, by name."""
    return {f.name: f.metadata["rule"] for f in fields(method)}


def check_settings(method: Any) -> None:
    """Refuse settings that no model could go with; objects that are no method pass.

    Raises
    ------
    ArgumentError : names the setting, its value and what it may be.
    """
    if isinstance(method, type) or not is_dataclass(method):
        return
    if not all("rule" in f.metadata for f in fields(method)):
        return
    for name, rule in rules_of(method).items():
        rule(name, getattr(method, name))
    if hasattr(method, "_check_together"):
        method._check_together()


def count(least: int) -> Rule:
    return lambda name, value: check_count(name, value, least)


def optional(rule: Rule) -> Rule:
    return lambda name, value: None if value is None else rule(name, value)


def number(fits: Callable[[float], bool], fix: str) -> Rule:
    return lambda name, value: check_number(name, value, fits, fix)


def flag(name: str, value: Any) -> None:
    if not isinstance(value, (bool, np.bool_)):
        raise ArgumentError(f"{name}={value!r}", fix="give True or False")


def a_name(name: str, value: Any) -> None:
    """Which names there are depends on the model, or is given where it is looked up."""
    if not isinstance(value, str):
        raise ArgumentError(f"{name}={value!r}", fix='give a name, as "auto"')


def one_of(valid: Sequence[str]) -> Rule:
    def rule(name: str, value: Any) -> None:
        if not isinstance(value, str) or value not in valid:
            fix = f"use one of: {listing(str(value), valid)}"
            raise ArgumentError(f"{name}={value!r}", fix=fix)

    return rule


def whole_number_to(most: int, fix: str) -> Rule:
    def rule(name: str, value: Any) -> None:
        check_number(name, value, lambda v: v in range(most + 1), fix)

    return rule


def finite_matrix(name: str, value: Any) -> None:
    """Its shape and definiteness are looked at once the parameters are known."""
    try:
        finite = bool(np.all(np.isfinite(np.asarray(value, dtype=float))))
    except (TypeError, ValueError):
        finite = False
    if not finite:
        raise ArgumentError(f"{name}={value!r}", fix="give a matrix of finite numbers, or None")


def scales_by_name(name: str, value: Any) -> None:
    pairs = list(value.items()) if isinstance(value, Mapping) else [(None, None)]
    if not all(isinstance(k, str) and isinstance(v, str) for k, v in pairs):
        raise ArgumentError(
            f"{name}={value!r}",
            fix='give scales by the names of parameters, as {"tau": "reciprocal"}, or None',
        )


def flag_or_auto(name: str, value: Any) -> None:
    if not (isinstance(value, bool) or (isinstance(value, str) and value == "auto")):
        raise ArgumentError(f"{name}={value!r}", fix='use "auto", True or False')


def flag_auto_or_names(name: str, value: Any) -> None:
    named = isinstance(value, (tuple, list)) and all(isinstance(n, str) for n in value)
    known = isinstance(value, str) and value == "auto"
    if not (named or known or isinstance(value, bool)):
        fix = 'use "auto", True, False or a tuple of parameters\' names'
        raise ArgumentError(f"{name}={value!r}", fix=fix)


def step_sizes(name: str, value: Any) -> None:
    for given in value.values() if isinstance(value, Mapping) else [value]:
        try:
            check_number(name, given, lambda v: v > 0.0, "")
        except ArgumentError:
            raise ArgumentError(
                f"{name}={value!r}",
                fix="give positive numbers, standard deviations on the unconstrained scale; hold "
                "a parameter still by fixed={...}",
            ) from None


def count_or_starts(name: str, value: Any) -> None:
    if not isinstance(value, Sequence) or isinstance(value, str):
        check_count(name, value, 1)
    elif not len(value):
        raise ArgumentError(f"{name} is empty", fix="give a number, or one mapping for each")
    elif not all(isinstance(v, Mapping) for v in value):
        fix = "give a number, or a list of mappings from names of parameters to values"
        raise ArgumentError(f"{name}={value!r}", fix=fix)


def rescue_factor(name: str, value: Any) -> None:
    """0, or a whole number that leaves room for more particles."""
    check_count(name, value, 0)
    if value == 1:
        raise ArgumentError(
            f"{name}=1 allows a row the N particles that it has anyway",
            fix=f"give how many times N particles a row may take, as {name}=100; 0: no rescue",
        )
