"""What a function is known by changes with all that it does, and with nothing else."""

import os
import subprocess
import sys
import textwrap
import types
from dataclasses import dataclass
from functools import partial

import numba
import numpy as np
import pytest

import ssmppl as ssm
from ssmppl.language.model.closure_digest import fingerprint


def globally(text, **outside):
    """The function `f` of a module with this text."""
    space = {"np": np, **outside}
    exec(textwrap.dedent(text), space)
    return space["f"]


def of_closure(c):
    def f(v, strength):
        return -strength * np.tanh(v / c)

    return f


def of_default(c):
    def f(v, strength, scale=c):
        return -strength * np.tanh(v / scale)

    return f


def of_keyword(c):
    def f(v, strength, *, scale=c):
        return -strength * np.tanh(v / scale)

    return f


def of_function_within(c):
    return globally(f"""
        def f(v, strength):
            def g(v):
                return np.tanh(v / {c!r})
            return -strength * g(v)
    """)


def of_global_within(c):
    return globally("f = lambda v, strength: [strength * np.tanh(w / V0) for w in v]", V0=c)


def of_called(c):
    return globally("def f(v, strength): return -strength * g(v)", g=of_default(c))


def of_called_at_once(c):
    return globally("def f(v, strength): return -strength * g(v)", g=numba.njit(of_closure(c)))


def of_partial(c):
    return globally("def f(v, strength): return -strength * g(v)", g=partial(of_default(1.0), c))


def of_module(c):
    own = types.ModuleType("own_constants")
    own.V0, own.OTHER = c, object()
    return globally("def f(v, strength): return -strength * np.tanh(v / own.V0)", own=own)


def of_module_by_text(c):
    own = types.ModuleType("own_constants")
    own.V0 = c
    return globally("def f(v, strength): return -strength * v / getattr(own, 'V0')", own=own)


def of_array(c):
    table = np.zeros(5000)
    table[2500] = c * 1e-9
    return globally("def f(v, strength): return -strength * table[2500] * v", table=table)


def of_mapping(c):
    return globally("def f(v, strength): return -strength * at['V0'] * v", at={"a": 1, "V0": c})


@dataclass
class Constants:
    V0: float

    def tanh(self, v):
        return np.tanh(v / self.V0)


def of_object(c):
    return globally("def f(v, strength): return -strength * own.tanh(v)", own=Constants(c))


def of_method(c):
    return globally("def f(v, strength): return -strength * tanh(v)", tanh=Constants(c).tanh)


def of_class(c):
    own = type("Own", (), {"V0": c})
    return globally("def f(v, strength): return -strength * np.tanh(v / Own.V0)", Own=own)


def of_primitive(c):
    def g(v):
        return v * c

    return globally("def f(v, strength): return -strength * g(v)", g=ssm.primitive(g))


WAYS = [
    of_closure, of_default, of_keyword, of_function_within, of_global_within, of_called,
    of_called_at_once, of_partial, of_module, of_module_by_text, of_array, of_mapping, of_object,
    of_method, of_class, of_primitive,
]  # fmt: skip


@pytest.mark.parametrize("make", WAYS)
def test_a_number_counts_wherever_it_comes_from(make):
    assert fingerprint(make(0.3)) == fingerprint(make(0.3)) != fingerprint(make(0.5))


def test_names_of_arguments_count():
    """By which an effect is bound: x and w are different quantities."""
    texts = ["def f(v, strength, x): return strength * x",
             "def f(v, strength, w): return strength * w"]  # fmt: skip
    assert len({fingerprint(globally(t)) for t in texts}) == 2


def test_what_is_not_used_does_not_count():
    text = "def f(v, strength): return -strength * v"
    assert fingerprint(globally(text, V0=0.3)) == fingerprint(globally(f"\n\n{text}", V0=0.5))


def test_what_leads_back_to_itself():
    text = """
        def f(v): return g(v) if v > 0 else NUMBERS
        def g(v): return f(v - 1)
    """
    numbers = [1.0]
    numbers.append(numbers)
    assert fingerprint(globally(text, NUMBERS=numbers)) == fingerprint(
        globally(text, NUMBERS=numbers)
    )


def test_every_process_gives_the_same():
    """With other addresses, and another order of sets; from the source, and from what is cached."""
    script = (
        "import tests.language.model.test_fingerprints as t\n"
        "g = t.globally('''def f(v, k): return v if k in {'a', 'b', 'c'} else np.mean(v)''')\n"
        "print([t.fingerprint(f) for f in (*(make(0.3) for make in t.WAYS), g)])"
    )
    told = {
        subprocess.run(
            [sys.executable, "-c", script], env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True, text=True, check=True,
        ).stdout
        for seed in ("1", "2")
    }  # fmt: skip
    assert len(told) == 1
    assert str([fingerprint(make(0.3)) for make in WAYS])[:-1] in told.pop()


def test_every_field_of_an_effect_counts():
    def changed(v, strength, lag):
        return -strength * v * lag

    def declared(**settings):
        own = {"on": "rate", "name": "own", "shapes": {"lag": (1.0, 2.0)}, **settings}
        return fingerprint(ssm.effect(changed, **own))

    others = [
        {}, {"name": "other"}, {"on": "any"}, {"form": "slow"}, {"lower": 0}, {"note": "why"},
        {"shapes": {"lag": (1.0, 3.0)}}, {"requires": "positive"}, {"afresh": 0.1},
        {"constant": "constant load"},
    ]  # fmt: skip
    found = [declared(**o) for o in others]
    assert found == [declared(**o) for o in others]
    assert len(set(found)) == len(found)


class Attributes(dict):
    """A dictionary read by attributes, which raises KeyError for those that it lacks."""

    __getattr__ = dict.__getitem__


class Lookup:
    def __init__(self, c):
        self.values = {"V0": c}

    def __getattr__(self, name):
        return self.__dict__["values"][name]


@pytest.mark.parametrize("kind", [lambda c: Attributes(V0=c), Lookup])
def test_objects_that_look_their_attributes_up_in_a_dictionary(kind):
    def of(c):
        settings = kind(c)
        return fingerprint(lambda v: np.tanh(v / settings.V0))

    assert of(1.0) == of(1.0)
    assert of(1.0) != of(2.0)


def test_slots_of_the_classes_above():
    class Gain:
        __slots__ = ("gain",)

    class Shifted(Gain):
        __slots__ = ("shift",)

    settings = Shifted()
    seen = set()
    for settings.gain, settings.shift in ((1, 0), (2, 0), (2, 1)):
        seen.add(fingerprint(lambda x: settings.gain * x + settings.shift))
    assert len(seen) == 3
