"""Kernels' text with a model's names in it, and without the branches that the model decides."""

import time
from concurrent.futures import ThreadPoolExecutor

from ssmppl.codegen.text import specialise as module
from ssmppl.codegen.text.specialise import specialise

NONE, SOME = 0, 1


def kernel(draw, sizes, kind, x, n):
    """Any kernel."""
    total = 0.0
    # before
    if kind != NONE:  # on the line
        total += draw(x)
    elif n > 1:
        total -= 1.0
    else:
        total += 2.0
    if n > 2:
        total += sizes[1]
    elif kind == SOME:
        # why
        total *= 2.0
    if sizes[0] > 0:
        if kind == NONE:
            total += 3.0
        total += 4.0
    else:
        total += 5.0
    return total


def text(kind, sizes):
    made = specialise(kernel, "made", {"draw": "draw_own", "sizes": sizes, "kind": kind})
    assert not made.imports or set(made.imports) <= {"NONE", "SOME"}
    return made.text


def run(kind, sizes, n):
    namespace = {"draw_own": lambda x: x, "NONE": NONE, "SOME": SOME}
    exec(text(kind, sizes), namespace)
    return namespace["made"](10.0, n)


def test_decided_branches_compute_the_same():
    for kind, k in (("NONE", NONE), ("SOME", SOME)):
        for sizes in ((0, 7), (2, 9)):
            for n in (1, 2, 3):
                expected = kernel(lambda x: x, sizes, k, 10.0, n)
                assert run(kind, str(sizes), n) == expected


def test_what_is_not_needed_is_not_in_the_text():
    made = text("NONE", "(0, 7)")
    assert "draw_own" not in made
    assert "why" not in made
    assert "+= 4.0" not in made
    assert "if n > 1:" in made
    assert "total += 7" in made
    assert "# before" in made
    assert text("SOME", "(2, 9)").count("if") == 1


def test_threads_do_not_parse_at_the_same_time(monkeypatch):
    """Python's parser fails now and then where they do, in 3.11."""
    inside, most, decided = [], [], module._decided

    def watched(*args):
        inside.append(1)
        time.sleep(0.005)
        most.append(len(inside))
        out = decided(*args)
        inside.pop()
        return out

    monkeypatch.setattr(module, "_decided", watched)
    with ThreadPoolExecutor(4) as pool:
        texts = list(pool.map(lambda k: text("NONE", f"(0, {100 + k})"), range(8)))
    assert len(set(texts)) == 8
    assert len(most) == 8  # none of them was known
    assert max(most) == 1
