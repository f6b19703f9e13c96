"""The generated module as text, and its cache on disk."""

import ast
import os
import re
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from ssmppl.analysis.density import Missing
from ssmppl.codegen.modules.program import compile_trace
from ssmppl.codegen.store import folder
from ssmppl.language.tracing import trace
from tests.models.statements import MODELS, build

ROOT = Path(__file__).parents[2]


# -- text
@pytest.mark.parametrize("name", MODELS)
def test_text(name):
    traced = trace(build(name))
    program = compile_trace(traced)
    text = program.source()
    compile(text, str(program.path), "exec")
    again = compile_trace(trace(build(name))).source()  # traced from another line: no difference
    same = text == program.path.read_text() == again
    assert same  # not compared in the assert itself: pytest would take minutes over the difference
    lines = {int(n) for n in re.findall(r"# statements\.py:(\d+)$", text, re.MULTILINE)}
    source = (ROOT / "tests/models/statements.py").read_text().splitlines()
    start = MODELS[name].__code__.co_firstlineno
    assert lines, "no line of the user's is named"
    assert all(start < n < start + 40 for n in lines)
    assert all(source[n - 1].strip() for n in lines)
    for role in ("initial", "transition"):
        for place in traced.functions[role]:
            assert f"statements.py:{place.line} {place.function}" in text  # the header


def test_names_are_the_users():
    text = compile_trace(trace(build("varves"))).source()
    assert re.search(r"= phi \* x_prevs\[i\]|phi \* x_prevs\[i\]", text)
    assert re.search(r"^ +tau = theta\[1\]$", text, re.MULTILINE)
    assert re.search(r"^def (\w+)\(", text, re.MULTILINE)
    for role in ("prepare", "step", "draw_initial", "draw", "weigh", "look_ahead"):
        assert f"def {role}_auxiliary(" in text


def test_no_name_is_bound_twice_to_different_things():
    """Arguments of a generated function are never assigned to."""
    for name in MODELS:
        for function in ast.parse(compile_trace(trace(build(name))).source()).body:
            if not isinstance(function, ast.FunctionDef):
                continue
            if not re.match(r"prepare|step|draw|weigh|look|moments|observe|connect|log_",
                            function.name):  # fmt: skip
                continue
            arguments = {a.arg for a in function.args.args}
            assigned = {
                t.id
                for node in ast.walk(function)
                if isinstance(node, ast.Assign)
                for t in node.targets
                if isinstance(t, ast.Name)
            }
            assert not arguments & assigned, (name, function.name)


def test_settings_make_modules_of_their_own():
    traced = trace(build("varves"))
    complete = compile_trace(traced, Missing(none=True))
    gappy = compile_trace(traced, Missing())
    assert complete.path != gappy.path
    assert "seen" not in complete.source().split("def step_auxiliary")[1].split("def ")[0].split(
        "):", 1
    )[1]  # fmt: skip


def test_the_digest_knows_text_kernels_and_versions(monkeypatch):
    assert folder.digest_of("a") != folder.digest_of("b")
    before = folder.digest_of("a")
    monkeypatch.setattr(folder, "_environment", lambda: b"other kernels")
    assert folder.digest_of("a") != before


# -- cache on disk, always in processes of their own
SCRIPT = """
import numpy as np
from ssmppl.analysis.conjugacy.derive import derive_updates
from ssmppl.codegen.modules.trajectory_sums import compile_updates, statistics_name
from ssmppl.language.tracing import trace
from tests.models.statements import build
traced = trace(build("linear_scalar"))
updates = derive_updates(traced)
module = compile_updates(traced, updates).module
run = getattr(module, statistics_name(updates[0]))  # the variant that Numba compiles and keeps
y, total = np.ones((3, 1)), np.empty(len(updates[0].functions))
run(np.array([0.5, 1.0, 1.0]), y, y, np.zeros((3, 0)), y + 0.3, total)
hits, misses = run.stats.cache_hits, run.stats.cache_misses
print(sum(hits.values()), sum(misses.values()), sum(total), module.__file__)
"""
SIMULATION = """
from ssmppl.codegen.modules.program import compile_trace
from ssmppl.codegen.kernels.math.random import new_state
from ssmppl.language.tracing import trace
from tests.models.statements import build
import numpy as np
program = compile_trace(trace(build("linear_scalar")))
y, out = np.zeros((3, 1)), (np.empty((3, 1, 1)), np.empty((3, 1, 1)))
program.entry("simulate")(
    np.array([0.5, 1.0, 1.0]), y, y + 1, np.zeros((3, 0)), new_state(np.random.SeedSequence(1)),
    *out, False,
)
print(0, 0, out[1].sum(), program.path)
"""


def start(folder, script=SCRIPT, **more):
    env = {**os.environ, "SSMPPL_CACHE": str(folder), "PYTHONPATH": str(ROOT), **more}
    env.pop("NUMBA_CACHE_DIR", None)
    return subprocess.Popen(
        [sys.executable, "-c", script], env=env, cwd=ROOT, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def finish(process):
    """(cache hits, cache misses, the number that was computed, path of the module)."""
    out, error = process.communicate(timeout=200)
    assert process.returncode == 0, error
    hits, misses, total, path = out.split()
    return int(hits), int(misses), float(total), Path(path)


def limited(place, size):
    """The script in a process that writes no file of more than so many bytes, as on a full disk."""
    limit = f"import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, ({size}, {size}))\n"
    return finish(start(place, limit + SCRIPT))


@pytest.mark.slow
def test_a_full_disk_ends_no_call(tmp_path):
    """Nothing can be written anywhere; only the text; then there is room again."""
    hits, misses, total, path = limited(tmp_path, 0)
    assert (hits, misses, path.exists()) == (0, 1, False)
    kept = tmp_path / "ssmppl"
    assert not list(kept.iterdir())
    assert finish(start(tmp_path))[:3] == (0, 1, total)
    (code,), (module,) = kept.glob("*.nbc"), kept.glob("*.py")
    between = module.stat().st_size + 1
    assert between <= code.stat().st_size
    module.unlink()
    code.unlink()
    assert limited(tmp_path, between)[:3] == (0, 1, total)
    assert module.exists()
    assert not code.exists()
    assert finish(start(tmp_path))[:3] == (0, 1, total)
    assert finish(start(tmp_path))[:3] == (1, 0, total)


def half(content):
    return content[: len(content) // 2]


def emptied(content):
    return b""


def another(content):
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


@pytest.mark.parametrize(
    "damage", [half, *(pytest.param(d, marks=pytest.mark.slow) for d in (another, emptied))]
)
def test_what_is_damaged_is_made_anew(tmp_path, damage):
    """Half a file, another bit, none: by a power cut, a full disk, a copy that stopped."""
    total = finish(start(tmp_path))[2]
    files = [f for f in (tmp_path / "ssmppl").iterdir() if f.is_file()]
    assert {f.suffix for f in files} >= {".py", ".nbc"}
    for file in files:
        file.write_bytes(damage(file.read_bytes()))
    assert finish(start(tmp_path))[:3] == (0, 1, total)
    assert finish(start(tmp_path))[:3] == (1, 0, total)


def test_two_processes_at_once_then_a_third(tmp_path):
    both = [finish(p) for p in [start(tmp_path), start(tmp_path)]]
    assert sorted(found[:2] for found in both) == [(0, 1), (1, 0)]  # one waits for the other
    assert both[0][2:] == both[1][2:]
    path = both[0][3]
    assert path.parent == tmp_path / "ssmppl"
    assert not [*path.parent.glob("*.tmp"), *path.parent.glob("*.lock")]
    assert finish(start(tmp_path)) == (1, 0, *both[0][2:])  # nothing is compiled again
    text = path.read_text()
    for spoilt in ("raise SystemExit('edited')\n", "", text + "\nentry = None\n"):
        path.write_text(spoilt)
        assert finish(start(tmp_path))[2:] == both[0][2:]
        restored = path.read_text() == text
        assert restored


def test_what_another_makes_is_waited_for(tmp_path, monkeypatch):
    monkeypatch.setenv("SSMPPL_CACHE", str(tmp_path))
    order, begun = [], threading.Event()

    def first():
        with folder.one_process("thing"):
            begun.set()
            time.sleep(0.2)
            order.append("made")

    other = threading.Thread(target=first)
    other.start()
    begun.wait()
    with folder.one_process("thing"):
        order.append("looked for")
    other.join()
    assert order == ["made", "looked for"]
    assert not list(folder.cache_folder().iterdir())


def test_it_is_not_waited_for_for_ever(tmp_path, monkeypatch):
    monkeypatch.setenv("SSMPPL_CACHE", str(tmp_path))
    monkeypatch.setattr(folder, "PATIENCE", 0.1)
    with folder.one_process("thing"):
        begun = time.monotonic()
        with folder.one_process("thing"):
            assert 0.1 <= time.monotonic() - begun < 30.0


@pytest.mark.skipif(os.geteuid() == 0, reason="root writes everywhere")
def test_a_folder_that_cannot_be_written(tmp_path):
    folder = tmp_path / "locked"
    folder.mkdir()
    folder.chmod(stat.S_IRUSR | stat.S_IXUSR)
    assert finish(start(folder))[3].parent.parent != folder


def test_a_file_where_the_folder_should_be(tmp_path):
    """As unwritable as a folder can be, for root too."""
    blocked = tmp_path / "file"
    blocked.write_text("")
    _, misses, _, path = finish(start(blocked))
    assert misses == 1
    assert tmp_path not in path.parents


def _planted(place, text):
    """In place of a generated module what somebody else would put there; raises when it is run."""
    path = place / f"planted_{folder.digest_of(text)}.py"
    path.write_text("raise SystemExit('this is not ours')")
    return path


def _opened(place):
    place.chmod(0o777)


def _given_away(place):
    if os.geteuid() != 0:
        pytest.skip("only root gives folders away")
    os.chown(place, 12345, -1)


@pytest.mark.parametrize(
    ("change", "words"), [(_opened, "others can write"), (_given_away, "somebody else")]
)
def test_a_folder_that_others_write_to_is_not_used(tmp_path, monkeypatch, change, words):
    monkeypatch.setenv("SSMPPL_CACHE", str(tmp_path))
    assert folder.cache_folder() == tmp_path / "ssmppl"
    assert stat.S_IMODE((tmp_path / "ssmppl").stat().st_mode) == 0o700
    text = f"x = 1  # {words}"  # each case a module of its own
    path = _planted(tmp_path / "ssmppl", text)
    change(tmp_path / "ssmppl")
    with pytest.warns(UserWarning, match=words) as caught:
        module = folder.load("planted", text)
    assert "SSMPPL_CACHE" in str(caught[0].message)
    assert module.x == 1
    assert tmp_path not in Path(module.__file__).parents
    assert "not ours" in path.read_text()


def test_runs_without_compiling(tmp_path):
    """NUMBA_DISABLE_JIT=1 gives the same numbers, for debugging."""
    compiled = finish(start(folder.cache_folder().parent, SIMULATION))
    debugged = finish(start(tmp_path, SIMULATION, NUMBA_DISABLE_JIT="1"))
    assert debugged[2] == pytest.approx(compiled[2], rel=1e-12)
