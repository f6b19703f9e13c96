"""Every effect on every model there is: what the tests of one effect after another go through.

The models are those of the tests, of the gallery (`examples`), of the benchmark (but for its sealed
half, by which nothing is to be tuned before it is opened) and of users (`cases`); the effects those
that a model is offered, the first shape of each. A triple is a model, an effect that is in it, and
another one that is added.
"""

import functools
import itertools
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.gap import arm
from bench.gap.plan import SPLIT
from ssmppl.analysis.density import Missing
from ssmppl.analysis.structure import linear_gaussian
from ssmppl.diagnosis.model.augment import augment, with_given_parameters
from ssmppl.diagnosis.model.basis import symbolic_shapes
from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.initial_law import needs_proper_initial_law
from ssmppl.diagnosis.model.score_columns import score_columns
from ssmppl.errors import NotApplicable
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbols_of
from ssmppl.language.tracing import trace
from ssmppl.modelfile import load_model
from tests.diagnosis import harness

ROOT = Path(__file__).parent.parent.parent
FOLDERS = {"example": "examples/*/model.py", "bench": "bench/gap/systems/*.py",
           "case": "tests/diagnosis/cases/[a-z]*.py"}  # fmt: skip
SEALED = {*SPLIT["halves"]["sealed"]["systems"], arm.NAME}
FILES = {
    (where, p.parent.name if where == "example" else p.stem): p
    for where, pattern in FOLDERS.items()
    for p in sorted(ROOT.glob(pattern))
    if where != "bench" or p.stem not in SEALED
}
MODELS = [*harness.EVERY, *FILES]
LAWS = ("initial", "transition", "observations")
POSITIVE = 8.0  # of scales: far from 0, for effects of what keeps its sign
ALMOST = 1e-9  # sums in another order


@functools.cache
def traced(where, name):
    """The trace of a model."""
    if (where, name) in FILES:
        return trace(load_model(str(FILES[where, name])))
    return harness.traced(where, name)


@functools.cache
def candidates(where, name):
    """The first of each group that the model is offered, whatever the signs of its quantities."""
    t = traced(where, name)
    out = {}
    for shift in (0.0, POSITIVE):
        for c in offers(t, harness.scales(t, shift=shift))[0]:
            out.setdefault(c.group, replace(c, strength=f"by_{len(out)}"))
    return list(out.values())


def pairs_of(where, name, share):
    """Ordered pairs of different effects: one in `share` of them, the same in every run."""
    first = zlib.crc32(name.encode()) % share
    return itertools.islice(itertools.permutations(candidates(where, name), 2), first, None, share)


def triples(model):
    """How many (model, effect, another effect) there are of a model."""
    number = len(candidates(*model))
    return number * (number - 1)


# -- laws in numbers
def laws(t, points=2):
    """(role, quantity, argument) -> its numbers, (points, ...), at random points.

    The same quantity has the same values in every trace: auxiliary states are known by the effect
    that they belong to (of those that share one, the first), as their names depend on the order.
    """
    known = {own: (strength, state) for strength, names in sorted(t.names.items(), reverse=True)
             for state, own in names.items()}  # fmt: skip
    keys, roots = [], []
    for role in LAWS:
        for site in getattr(t, role).values():
            for argument, values in site.distribution.parameters.items():
                at = np.asarray(values, dtype=object).ravel()
                kind = type(site.distribution).__name__
                keys += [(role, known.get(site.name, site.name), kind, argument, i)
                         for i in range(len(at))]  # fmt: skip
                roots += list(at)
    at = {s: _value(s, known, points) for s in symbols_of(roots)}
    with np.errstate(all="ignore"):
        found = evaluate(roots, at)
    return {k: np.broadcast_to(v, points) for k, v in zip(keys, found, strict=True)}


def _value(s, known, points):
    kind, name, index = (*s.data, ())[:3]
    text = repr((kind, known.get(name, name), index))
    values = np.random.default_rng(zlib.crc32(text.encode())).uniform(0.3, 0.9, points)
    if kind == "parameter" and name.startswith("by_"):
        return 0.1 * values  # a strength
    return values + 2.0 * (len(index) == 2 and index[0] == index[1])  # of covariances


def different(one, other):
    """The laws in which two traces differ."""
    a, b = (laws(t) if not isinstance(t, dict) else t for t in (one, other))
    if a.keys() != b.keys():
        return [f"only in one: {k}" for k in a.keys() ^ b.keys()]
    out = []
    for k, v in a.items():
        with np.errstate(all="ignore"):
            if not np.allclose(v, b[k], rtol=ALMOST, atol=ALMOST, equal_nan=True):
                out.append(f"{k}: {v} against {b[k]}")
    return out


# -- what is asked of a model before anything is compiled or fitted
def analysed(t):
    """What fits ask of an augmented model: what structure it has, and whether it can start."""
    needs_proper_initial_law(t)
    found = linear_gaussian(t)
    assert found is not None
    return found


def scored(t, added):
    """The columns that a screen asks of a model, for these effects; why some have none."""
    unique = {c.increment.key: c.increment for c in added}
    made, shapes = symbolic_shapes(list(unique.values()))
    superset = with_given_parameters(augment(t, made), shapes)
    names = [c.strength for c in made]
    found = score_columns(t, superset, names, (), Missing())
    own = {repr(s) for s in t.parameter_symbols}
    assert set(found.names) | set(found.refused) - own == set(names)
    assert all(isinstance(r, NotApplicable) and r.reason for r in found.refused.values())
    return found
