"""The table of operations is complete, and its phrases group as Python does."""

import ast
import itertools
import re

import pytest

from ssmppl.expressions.operations import OPERATIONS, WRITTEN, Level, Phrase


def test_every_operation_has_a_meaning():
    assert all(callable(o.function) for o in OPERATIONS.values())


@pytest.mark.parametrize("name", OPERATIONS)
def test_phrases_use_every_operand(name):
    operation = OPERATIONS[name]
    for phrase in (operation.written, operation.plain):
        if isinstance(phrase, Phrase):
            used = set(map(int, re.findall(r"{(\d)}", phrase.template)))
            assert used == set(range(operation.operands)) == set(range(len(phrase.operands)))


@pytest.mark.parametrize("outer", WRITTEN)
def test_parentheses_stand_where_python_needs_them(outer):
    for inner, place in itertools.product(WRITTEN, range(OPERATIONS[outer].operands)):
        if outer == inner and outer in ("and", "or"):
            continue  # Python has one node for a and b and c
        inside = WRITTEN[inner].of([(n, Level.ATOM) for n in "abc"[: OPERATIONS[inner].operands]])
        parts = [(n, Level.ATOM) for n in "xyz"[: OPERATIONS[outer].operands]]
        plain, bracketed = ([*parts[:place], p, *parts[place + 1 :]]
                            for p in (inside, (f"({inside[0]})", Level.ATOM)))  # fmt: skip
        texts = [WRITTEN[outer].of(p)[0] for p in (plain, bracketed)]
        assert len({ast.dump(ast.parse(t)) for t in texts}) == 1, texts
