"""What a question needs next is compiled by another process meanwhile; no answer depends on it."""

import json
import os
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from ssmppl.codegen.store import beforehand

ROOT = Path(__file__).parents[3]
KERNELS = '''
import numpy as np
from ssmppl.codegen.store import folder

HEAD = """import numba

entry = numba.njit(nogil=True)


@entry
"""


def total(x):
    text = HEAD + "def total(x):\\n    return x.sum()\\n"
    return float(folder.load("total", text).total(np.asarray(x)))


def product(x):
    text = HEAD + "def product(x):\\n    return x.prod()\\n"
    return float(folder.load("product", text).product(np.asarray(x)))
'''
BEGIN = """
import json, operator, os, threading, time
from functools import partial
import numpy as np
from kernels import product, total
from ssmppl.codegen.store import beforehand, folder

compiled, save, numbers = [], folder.Kept.save_overload, np.array([2.0, 3.0, 4.0])

def saved(self, signature, done):
    compiled.append(self._stem.partition("_")[0])
    save(self, signature, done)

folder.Kept.save_overload = saved

def tell(*found):
    print(json.dumps([*found, compiled]), flush=True)
"""

needs_two = pytest.mark.skipif(
    beforehand._processors() < 2, reason="on one processor nothing is compiled beforehand"
)


def answers(code, folder, **more):
    """What a process of its own tells; the cache is in the folder."""
    (folder / "kernels.py").write_text(KERNELS)
    env = {k: v for k, v in os.environ.items() if k != beforehand.ALONE}
    env |= {"SSMPPL_CACHE": str(folder), "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}
    text = BEGIN + textwrap.dedent(code)
    done = subprocess.run(
        [sys.executable, "-c", text], env=env | more, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@needs_two
def test_what_comes_later_is_kept_by_another_process(tmp_path):
    broken = "partial(operator.truediv, 1, 0)"  # of no interest
    code = f"""
    with beforehand.beforehand({broken}, partial(product, numbers)):
        first = total(numbers)
    beforehand._running[0].wait(120)
    tell(first, product(numbers))
    """
    assert answers(code, tmp_path) == [9.0, 24.0, ["total"]]


@needs_two
def test_nothing_is_started_where_nothing_has_to_be_compiled(tmp_path):
    code = """
    total(numbers)
    with beforehand.beforehand(partial(product, numbers)):
        total(numbers)
    started = len(beforehand._running)
    product(numbers)  # after the question
    tell(started, len(beforehand._running), len(folder.on_missing))
    """
    assert answers(code, tmp_path)[:3] == [0, 0, 0]


@needs_two
@pytest.mark.parametrize("why", ["asked for", "cannot travel"])
def test_without_another_process_all_is_compiled_here(tmp_path, why):
    given = "partial(product, numbers)" if why == "asked for" else "threading.Lock().acquire"
    code = f"""
    with beforehand.beforehand({given}):
        first = total(numbers)
    tell(len(beforehand._running), first, product(numbers))
    """
    more = {beforehand.ALONE: "1"} if why == "asked for" else {}
    assert answers(code, tmp_path, **more) == [0, 9.0, 24.0, ["total", "product"]]


def gone(pid):
    """Whether a process has ended, within half a minute."""
    for _ in range(300):
        try:
            os.kill(pid, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False


@needs_two
@pytest.mark.skipif(os.name != "posix", reason="looks a process up by a signal")
@pytest.mark.parametrize("how", ["os._exit(0)", "beforehand.end()", "another question"])
def test_it_ends_with_who_asked_and_with_the_next_question(tmp_path, how):
    after = how
    if how == "another question":
        after = "with beforehand.beforehand(partial(time.sleep, 0)): product(numbers)"
    code = f"""
    with beforehand.beforehand(partial(time.sleep, 600)):
        total(numbers)
    tell(beforehand._running[0].pid)
    {after}
    """
    assert gone(answers(code, tmp_path)[0])


@needs_two
@pytest.mark.slow
def test_a_maximum_is_the_same_and_compiles_less_itself(tmp_path):
    code = """
    import ssmppl as ssm
    counts = ssm.Model("counts")
    counts.prior(lambda: {"q": ssm.HalfNormal(sd=0.3)})
    counts.initial(lambda: {"x": ssm.Normal(1, sd=0.3)})
    counts.transition(lambda x, q: {"x": ssm.Normal(0.9 * x, sd=q)})
    counts.observation(lambda x: {"y": ssm.Poisson(np.exp(x))})
    y = np.random.default_rng(1).poisson(3.0, 20).astype(float)
    found = ssm.maximize(counts, {"y": y}, seed=1, progress=False)
    tell(found.log_likelihood.hex(), len(beforehand._running))
    """
    (tmp_path / "alone").mkdir()
    alone = answers(code, tmp_path / "alone", **{beforehand.ALONE: "1"})
    both = answers(code, tmp_path)
    assert alone[1] == 0
    assert both[1] == 1
    assert both[0] == alone[0]
    assert "gaussian" in alone[2]
    assert set(both[2]) < set(alone[2])


@needs_two
@pytest.mark.slow
@pytest.mark.exhaustive
def test_chains_are_the_same(tmp_path):
    code = """
    import ssmppl as ssm
    level = ssm.Model("level")
    level.prior(lambda: {"q": ssm.InverseGamma(2, scale=0.1), "r": ssm.HalfNormal(sd=1.0)})
    level.initial(lambda: {"x": ssm.Normal(0, sd=1.0)})
    level.transition(lambda x, q: {"x": ssm.Normal(x + 0.1 * np.sin(x), variance=q)})
    level.observation(lambda x, r: {"y": ssm.StudentT(4.0, x, scale=r)})
    y = np.cumsum(np.random.default_rng(1).normal(size=30))
    few = {"draws": 20, "warmup": 20, "chains": 1, "seed": 1, "progress": False}
    found = ssm.sample(level, {"y": y}, **few)
    tell(float(found.posterior["q"].sum()).hex(), len(beforehand._running))
    """
    (tmp_path / "alone").mkdir()
    alone = answers(code, tmp_path / "alone", **{beforehand.ALONE: "1"})
    both = answers(code, tmp_path)
    assert both[:2] == [alone[0], 1]
    assert alone[1] == 0
    assert set(both[2]) < set(alone[2])
