"""The updates derived for a corpus of models: families, blocks, corrections."""

import pytest

from ssmppl.analysis.conjugacy import derive_updates
from ssmppl.expressions.expr import to_text
from ssmppl.language.trace import trace
from tests.analysis.corpus import CORPUS, build


@pytest.mark.parametrize("name", CORPUS)
def test_corpus(name):
    model, blocks, corrections = build(name)
    updates = derive_updates(trace(model))
    found = sorted((u.block, u.family) for u in updates)
    expected = sorted(b[:2] for b in blocks for _ in range(b[2] if len(b) > 2 else 1))
    assert found == expected, "\n".join(str(u.explanation) for u in updates)
    outside = [to_text(u.functions[j]) for u in updates for j in u.correction]
    assert outside == list(corrections)
