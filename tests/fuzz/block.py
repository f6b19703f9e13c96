"""All cases of one random model: its text is written, loaded and explained, then called."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import ssmppl as ssm
from ssmppl.language.tracing import trace
from ssmppl.modelfile import load_model
from tests.codegen.harness import Numbers
from tests.codegen.native_calls import both_ways, sections
from tests.fuzz.calls import Case, LeftOut, Outcome, Wrong, judged, random_call
from tests.fuzz.later import LATER, LaterCase
from tests.fuzz.models import Recipe, random_model

CALLS = 40  # on one model; the first are the same whatever their number
PARTICLES, REPEATS = 100, 200  # of the estimates that are held against an exact likelihood


def recipe_of(root: int, number: int) -> tuple[Recipe, np.random.Generator]:
    """The model of this number, and the generator of what is done with it."""
    model_rng, call_rng = (np.random.default_rng([root, number, k]) for k in range(2))
    return random_model(model_rng), call_rng


def cases(root: int, number: int, folder: Path, calls: int = CALLS) -> Iterator[Outcome]:
    """Outcomes one after the other; a broken model ends with the error that tells it."""
    recipe, rng = recipe_of(root, number)
    file = folder / f"random_{root}_{number}.py"
    file.write_text(recipe.text)
    made: dict[str, ssm.Model] = {}

    def load() -> None:
        made["model"] = load_model(str(file))
        str(ssm.explain(made["model"]))

    first = judged("load", load, file.name)
    yield first
    if first.kind != "result":
        return
    model = made["model"]
    yield judged("compiled = interpreted", lambda: agree(model, rng), file.name)
    if recipe.linear:
        yield judged("unbiased", lambda: unbiased(model, recipe, rng), file.name)
    case = LaterCase(rng, model, recipe, file=file)
    for _ in range(calls):
        verb, call = random_call(case, LATER)
        yield judged(verb, call, file.name)


def agree(model: ssm.Model, rng: np.random.Generator) -> None:
    """Native functions of the model leave the numbers of the interpreter in all arguments.

    Where rounding is blown up by what the model does with it, they may differ by more than it.
    """
    traced, gaps = trace(model), bool(rng.random() < 0.5)
    try:
        with np.errstate(all="ignore"):
            numbers = Numbers(traced, rng, gaps)
    except ValueError as error:  # of NumPy's samplers: a law whose parameters are no good
        raise LeftOut(str(error)) from error
    plain, parts = sections(traced, gaps)
    for name, section, text in parts:
        try:
            found = both_ways(plain, name, section, text, numbers, rng)
            for what, native, interpreted, near in found:
                if np.allclose(native, interpreted, rtol=1e-7, atol=1e-9, equal_nan=True):
                    continue
                if not within(native, interpreted, near()):
                    raise Wrong(f"{what}: {native} native, {interpreted} interpreted")
                raise LeftOut(f"{what}: rounding blown up")
        except ZeroDivisionError as error:  # which Python's own numbers refuse
            raise LeftOut(f"{name}: {error}") from error


def within(native: np.ndarray, interpreted: np.ndarray, near: np.ndarray) -> bool:
    """Whether numbers differ by no more than some roundings of their arguments make them."""
    with np.errstate(invalid="ignore"):
        close = np.isclose(native, interpreted, rtol=1e-7, atol=1e-9, equal_nan=True)
        return bool(np.all(close | (abs(native - interpreted) <= 20 * abs(near - interpreted))))


def unbiased(model: ssm.Model, recipe: Recipe, rng: np.random.Generator) -> None:
    """The mean of likelihood estimates against Kalman's, within five standard errors.

    The series is simulated by the model itself and short, so that the estimates spread little;
    where they spread by more than half of their mean, nothing is said.
    """
    at = Case(rng, model, recipe, odd=0.0).parameters()
    inputs = {n: rng.normal(size=(4, k) if k > 1 else 4) for n, k in recipe.inputs.items()}
    drawn = ssm.simulate(model, at, steps=4, inputs=inputs or None, seed=int(rng.integers(1e6)))
    data: dict[str, Any] = {n: drawn[n].values[0] for n in recipe.channels} | inputs
    (exact,) = ssm.log_likelihood(model, data, at, proposal="kalman")
    given = {"particles": PARTICLES, "repeats": REPEATS, "seed": int(rng.integers(1e6))}
    logs = ssm.log_likelihood(model, data, at, proposal="bootstrap", **given)
    ratios = np.exp(logs - exact)
    error = ratios.std(ddof=1) / np.sqrt(REPEATS)
    if ratios.std(ddof=1) > 0.5 * ratios.mean():
        raise LeftOut("the estimates spread too much")
    if abs(ratios.mean() - 1) > 5 * error + 1e-9:
        raise Wrong(f"mean ratio {ratios.mean():.4f} +- {error:.4f} to the exact likelihood")
