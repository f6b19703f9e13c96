"""Candidates for the test models, and comparison of traces expression by expression."""

import functools

import numpy as np

from ssmppl.diagnosis.model.candidates import offers
from ssmppl.diagnosis.model.scales import Scales
from ssmppl.expressions.arrays import array
from ssmppl.language.distributions import Truncated
from ssmppl.language.tracing import trace
from tests.analysis.conjugacy import corpus
from tests.models import gaps as models
from tests.models import statements as features
from tests.statistics.checks import seed_of

ROLES = ("parameters", "initial", "transition", "observations", "proposal")
EVERY = (
    [("gap", n) for n in models.MODELS]
    + [("corpus", n) for n in corpus.CORPUS]
    + [("features", n) for n in features.MODELS]
)


@functools.cache
def traced(where, name):
    """The trace of a test model."""
    build = {"gap": models.build, "corpus": lambda n: corpus.build(n)[0],
             "features": features.build}[where]  # fmt: skip
    return trace(build(name))


def scales(t, rows=300, shift=0.0):
    """Scales from made-up values round `shift`."""
    rng = np.random.default_rng(seed_of("scales", t.name))
    draw = [rng.standard_normal((200, len(s))) + shift
            for s in (t.state_symbols, t.observation_symbols, t.input_symbols)]  # fmt: skip
    return Scales.of(t, *draw, rows)


@functools.cache
def offered(where, name):
    """(candidates, what is refused) of a test model; tanks hold positive levels."""
    t = traced(where, name)
    return offers(t, scales(t, shift=6.0 if "tank" in name else 0.0))


def content(d):
    """Kind and parameters of a law: equal for laws that are the same, expression by expression."""
    inside = content(d.base) if isinstance(d, Truncated) else []
    nodes = [(n, a.shape, *map(id, array(a).ravel())) for n, a in d.parameters.items()]
    return [type(d).__name__, *inside, *nodes]


def nodes(d):
    """All expressions of a law's parameters."""
    return [e for a in d.parameters.values() for e in array(a).ravel()]


def differences(a, b):
    """Where two traces differ."""
    out = []
    for role in ROLES:
        one, other = getattr(a, role), getattr(b, role)
        if list(one) != list(other):
            out.append(f"{role}: {list(one)} against {list(other)}")
            continue
        out += [
            f"{role} of {n}: {one[n].distribution} against {other[n].distribution}"
            for n in one
            if content(one[n].distribution) != content(other[n].distribution)
        ]
    return out + (["inputs"] if a.inputs != b.inputs else [])
