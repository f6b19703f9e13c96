"""What a compiled function or a traced law is known by: all that it computes with."""

import math
import subprocess
import sys
import types
from enum import IntEnum

import numba
import numpy as np
import pytest

import ssmppl as ssm

CONSTANTS = types.ModuleType("constants_of_a_user")
sys.modules[CONSTANTS.__name__] = CONSTANTS


def simulated_mean(observed):
    """E[y | x = 2] of the model with this law's mean, exact to the noise of 1e-9."""
    model = ssm.Model("read")
    model.initial(lambda: {"x": ssm.Dirac(2.0), "w": ssm.Normal(0, sd=1)})
    model.transition(lambda x, w: {"x": ssm.Dirac(x), "w": ssm.Normal(w, sd=1)})
    model.observation(lambda x: {"y": ssm.Normal(observed(x), sd=1e-9)})
    return lambda: float(ssm.simulate(model, {}, steps=1, seed=1)["y"].values.ravel()[0])


def long_table(k):
    table = np.zeros(3000)
    table[1500] = k

    def read(v):
        return table[1500] * v

    return read


def fine_array(k):
    table = np.array([1.0 + k * 1e-12])

    def read(v):
        return (table[0] - 1.0) * 1e12 * v

    return read


def of_a_module(k):
    CONSTANTS.GAIN = k

    def read(v):
        return CONSTANTS.GAIN * v

    return read


def function_of_a_module(k):
    CONSTANTS.f = numba.njit(lambda v: k * v)

    def read(v):
        return CONSTANTS.f(v)

    return read


def inner(k):
    names = {}
    exec(f"def read(v):\n    def g(a):\n        return {k!r} * a\n    return g(v)", names)
    return names["read"]


def comprehension(k):
    names = {}
    text = f"for c in [{k!r} * j for j in range(2)]:\n        s += c"
    exec(f"def read(v):\n    s = 0.0\n    {text}\n    return s * v", names)
    return names["read"]


def read_inside(k):
    names = {"GAIN": k}
    exec("def read(v):\n    def g(a):\n        return GAIN * a\n    return g(v)", names)
    return names["read"]


def default_of_called(k):
    @numba.njit
    def g(v, gain=k):
        return gain * v

    def read(v):
        return g(v)

    return read


def vectorised(k):
    g = numba.vectorize(lambda v: k * v)

    def read(v):
        return g(v)

    return read


def member(k):
    class Gain(IntEnum):
        LOW = int(k)

    def read(v):
        return v if Gain.LOW == 1 else 5.0 * v

    return read


@pytest.mark.parametrize(
    "make",
    [long_table, fine_array, of_a_module, function_of_a_module, inner, comprehension, read_inside,
     default_of_called, vectorised, member],
)  # fmt: skip
def test_a_changed_primitive_runs_its_new_code(make):
    names = []
    for k in (1.0, 5.0, 1.0):
        primitive = ssm.primitive(make(k))
        names.append(primitive.name)
        assert simulated_mean(primitive)() == pytest.approx(2.0 * k, abs=1e-3)
    assert names[0] == names[2] != names[1]


def test_options_of_called_functions_are_a_part_of_the_name():
    def make(**options):
        g = numba.njit(**options)(lambda v: v / 3.0)
        return ssm.primitive(lambda v: g(v))

    assert make(fastmath=True).name != make(fastmath=False).name
    assert make(fastmath=True).name == make(fastmath=True).name


@pytest.mark.slow
def test_a_name_is_the_same_in_every_process_and_new_where_a_file_changed(tmp_path):
    """Sets, whose order differs from process to process, and libraries among what is read."""
    (tmp_path / "a_model.py").write_text(
        "import math\nimport numpy as np\nimport a_file\nimport ssmppl as ssm\n"
        "from math import tanh\n"
        "@ssm.primitive\ndef f(v):\n"
        "    if a_file.MODE in {'one', 'two', 'three'}:\n"
        "        return a_file.f(v) + np.exp(v) - np.exp(v) + math.pi - math.pi\n"
        "    return tanh(v)\n"
        "print(f.name, f(2.0))\n"
    )

    def run(gain, seed):
        (tmp_path / "a_file.py").write_text(
            f"import numba\nMODE = 'two'\nG = {gain}\n@numba.njit\ndef f(v):\n    return G * v\n"
        )
        call = [sys.executable, "-B", "a_model.py"]
        environment = {"PYTHONHASHSEED": str(seed), "PYTHONPATH": ":".join([*sys.path])}
        done = subprocess.run(call, cwd=tmp_path, env=environment, capture_output=True, check=True)
        return done.stdout.decode().split()

    first, again, changed = run(1.0, 1), run(1.0, 2), run(50.0, 1)
    assert first == again
    assert float(changed[1]) == pytest.approx(100.0)
    assert changed[0] != first[0]


def test_a_lambda_may_be_a_primitive():
    primitive = ssm.primitive(lambda v: 3.0 * math.tanh(v))
    assert simulated_mean(primitive)() == pytest.approx(3.0 * math.tanh(2.0), abs=1e-6)
    assert primitive.name.isidentifier()


class Settings:
    """What a user keeps constants in."""

    shared = 1.0

    def __init__(self):
        self.gain = 1.0

    def scaled(self, x):
        return self.gain * x

    def __call__(self, x):
        return self.gain * x


GAIN = 1.0


def helper(x):
    return GAIN * x


@ssm.distribution
def shifted(y, m):
    return -0.5 * ((y - helper(m)) / 1e-9) ** 2 - np.log(1e-9) - 0.5 * np.log(2 * np.pi)


@shifted.sampler
def draw(rng, m):
    return helper(m) + 1e-9 * rng.normal()


def test_a_law_is_traced_anew_where_what_it_reads_changed(monkeypatch):
    settings, arrays, slotted = Settings(), [np.zeros(3000)], {"g": np.float64(1.0)}
    arrays[0][1500] = 1.0
    CONSTANTS.GAIN = 1.0
    laws = {
        "module": lambda x: CONSTANTS.GAIN * x,
        "function": helper,
        "object": lambda x: settings.gain * x,
        "method": lambda x: settings.scaled(x),
        "bound method": settings.scaled,
        "called object": lambda x: settings(x),
        "class": lambda x: Settings.shared * x,
        "list of arrays": lambda x: arrays[0][1500] * x,
        "mapping": lambda x: slotted["g"] * x,
    }
    means = {name: simulated_mean(law) for name, law in laws.items()}
    assert {n: round(mean(), 3) for n, mean in means.items()} == dict.fromkeys(laws, 2.0)
    monkeypatch.setattr(CONSTANTS, "GAIN", 5.0)
    monkeypatch.setitem(globals(), "GAIN", 5.0)
    monkeypatch.setattr(Settings, "shared", 5.0)
    settings.gain, arrays[0][1500], slotted["g"] = 5.0, 5.0, np.float64(5.0)
    assert {n: round(mean(), 3) for n, mean in means.items()} == dict.fromkeys(laws, 10.0)


def test_a_law_of_ones_own_is_made_anew_where_its_helper_reads_another_number(monkeypatch):
    model = ssm.Model("own law")
    model.initial(lambda: {"x": ssm.Normal(2.0, sd=1e-9)})
    model.transition(lambda x: {"x": ssm.Normal(x, sd=1)})
    model.observation(lambda x: {"y": shifted(x)})

    def mean():
        return float(ssm.simulate(model, {}, steps=1, seed=1)["y"].values.ravel()[0])

    assert mean() == pytest.approx(2.0, abs=1e-6)
    monkeypatch.setitem(globals(), "GAIN", 5.0)
    assert mean() == pytest.approx(10.0, abs=1e-6)


def test_an_unchanged_model_is_traced_once():
    settings = Settings()
    model = ssm.Model("still")
    model.initial(lambda: {"x": ssm.Normal(settings.gain, sd=1)})
    model.transition(lambda x: {"x": ssm.Normal(settings.scaled(x), sd=np.array([1.0])[0])})
    assert model.signature == model.signature
