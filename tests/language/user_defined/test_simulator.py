"""@ssm.simulator: how it is called, and what is told of functions that cannot be computed with."""

import pickle
import threading
import warnings
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest

import ssmppl as ssm

T = 12
DATA = {"y": np.sin(np.arange(T) / 3.0), "u": np.cos(np.arange(T) / 2.0)}
AT = {"k": 1.3, "s": 0.2}


def step(state, inputs, parameters):
    """A damped spring, by semi-implicit steps."""
    q, v = state.T
    for _ in range(5):
        v = v + 0.05 * (inputs[:, 0] - parameters[:, 0] * q - 0.4 * v)
        q = q + 0.05 * v
    return np.stack([q, v], axis=1)


spring = ssm.simulator(state=["q", "v"], inputs=["u"], parameters=["k"])(step)


def model_of(function, **options):
    given = {"state": ["q", "v"], "inputs": ["u"], "parameters": ["k"]} | options
    spring = function if isinstance(function, ssm.Simulator) else ssm.simulator(**given)(function)
    model = ssm.Model("spring", inputs=("u",))

    @model.prior
    def prior():
        return {"k": ssm.HalfNormal(sd=3), "s": ssm.HalfNormal(sd=1)}

    @model.initial
    def initial():
        return {"q": ssm.Normal(0, sd=0.3), "v": ssm.Normal(0, sd=0.3)}

    @model.transition
    def transition(q, v, u, k, s):
        new = spring(q=q, v=v, u=u, k=k)
        return {"q": ssm.Dirac(new.q), "v": ssm.Normal(new["v"], sd=s)}

    @model.observation
    def observation(q):
        return {"y": ssm.Normal(q, sd=0.1)}

    return model


def log_likelihood(function, **options):
    return ssm.log_likelihood(model_of(function, **options), DATA, AT)


def particles(function, n):
    options = {"particles": n, "proposal": "bootstrap", "seed": 1}
    return ssm.log_likelihood(model_of(function), DATA, AT, **options)


def called(function):
    """The values at three points, by a simulator of this function."""
    own = ssm.simulator(state=["q", "v"], inputs=["u"], parameters=["k"])(function)
    return own(q=np.array([0.1, -0.4, 2.0]), v=0.3, u=1.0, k=1.3).vector


def test_that_the_automatic_likelihood_is_approximate_is_told():
    with pytest.warns(UserWarning, match="an approximation, by the extended Kalman filter"):
        told = ssm.log_likelihood(model_of(step), DATA, AT)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ssm.log_likelihood(model_of(step), DATA, AT, proposal="extended") == told


class TestCalls:
    def test_on_numbers_by_name_and_by_vectors(self):
        named = spring(q=0.5, v=-0.1, u=1.0, k=1.3)
        vectors = spring([0.5, -0.1], [1.0], {"k": 1.3})
        direct = step(np.array([[0.5, -0.1]]), np.array([[1.0]]), np.array([[1.3]]))[0]
        assert (named.q, named["v"]) == (vectors.q, vectors.v) == tuple(direct)
        assert list(named) == ["q", "v"]
        np.testing.assert_array_equal(named.vector, direct)

    def test_on_arrays_that_broadcast(self):
        found = spring(q=np.zeros((3, 1)), v=np.linspace(0, 1, 4), u=0.0, k=2.0)
        assert found.q.shape == (3, 4)

    def test_forces_may_be_left_out(self):
        def pushed(state, inputs, parameters):
            return state + inputs[:, :1] + 10.0 * inputs[:, 1:]

        own = ssm.simulator(state="x", inputs=["u", "f"], forces="f")(pushed)
        assert own(x=1.0, u=2.0).x == 3.0
        assert own(x=1.0, u=2.0, f=1.0).x == 13.0

    @pytest.mark.parametrize(
        ("given", "words"),
        [
            ({"q": 0.0, "v": 0.0, "u": 0.0}, "no value for k"),
            ({"q": 0.0, "v": 0.0, "u": 0.0, "kk": 1.0}, "unknown 'kk'"),
            ({"q": "a", "v": 0.0, "u": 0.0, "k": 1.0}, "for 'q'"),
        ],
    )
    def test_names_that_do_not_fit(self, given, words):
        with pytest.raises(ssm.ModelError, match=words):
            spring(**given)

    def test_a_result_that_there_is_not(self):
        with pytest.raises(ssm.ModelError, match="gives no 'w'"):
            _ = spring(q=0.0, v=0.0, u=0.0, k=1.0).w
        with pytest.raises(ssm.ModelError, match="has no outputs"):
            spring.sense(q=0.0, v=0.0, u=0.0, k=1.0)

    @pytest.mark.parametrize(
        ("options", "words"),
        [
            ({"state": []}, "no state"),
            ({"state": ["q", "q"]}, "'q' stands twice"),
            ({"state": "q", "outputs": "z"}, "belong together"),
            ({"state": "q", "forces": "f"}, "'f' is no input"),
            ({"state": "q", "scales": {"w": 1.0}}, "scales has 'w'"),
            ({"state": "q", "scales": {"q": 0.0}}, "scale of 'q'"),
        ],
    )
    def test_declarations_that_do_not_fit(self, options, words):
        with pytest.raises(ssm.ModelError, match=words):
            ssm.simulator(**options)


class TestFunctionsThatCannotBeComputedWith:
    def test_an_exception_is_told_with_row_arguments_and_traceback(self):
        def fails(state, inputs, parameters):
            if np.any(inputs[:, 0] == DATA["u"][6]):
                raise ZeroDivisionError("the gear is stuck")
            return step(state, inputs, parameters)

        with pytest.raises(ssm.SimulatorError) as caught:
            log_likelihood(fails)
        text = str(caught.value)
        assert "row 7: " in text  # u_t of the row counted from 1 that the step begins at
        assert "k = 1.3" in text
        assert "ZeroDivisionError: the gear is stuck" in text
        assert 'raise ZeroDivisionError("the gear is stuck")' in text
        assert "in _from_compiled" not in text

    def test_the_next_call_is_not_troubled_by_it(self):
        fail = [True]

        def fails(state, inputs, parameters):
            if fail[0]:
                raise RuntimeError("once")
            return step(state, inputs, parameters)

        model = model_of(fails)
        with pytest.raises(ssm.SimulatorError):
            ssm.log_likelihood(model, DATA, AT)
        fail[0] = False
        assert ssm.log_likelihood(model, DATA, AT)[0] == log_likelihood(step)[0]

    def test_an_exception_in_a_particle_filter(self):
        def fails(state, inputs, parameters):
            if len(state) > 90:
                raise ValueError("too many")
            return step(state, inputs, parameters)

        with pytest.raises(ssm.SimulatorError, match="too many"):
            particles(fails, 100)

    @pytest.mark.parametrize(
        ("result", "words"),
        [
            (lambda x: x[:, :1], r"shape \(\d+, 1\)"),
            (lambda x: x.T, "shape"),
            (lambda x: x[0], "shape"),
            (lambda x: x.astype(np.float32), "float32"),
            (lambda x: x + 0j, "complex"),
            (lambda x: None, "object"),
            (lambda x: [["a", "b"]] * len(x), "<U1"),
        ],
    )
    def test_another_shape_or_type(self, result, words):
        with pytest.raises(ssm.SimulatorError, match=words):
            called(lambda *args: result(step(*args)))

    def test_whole_numbers_and_lists_will_do(self):
        np.testing.assert_array_equal(called(lambda *a: step(*a).tolist()), called(step))

    def test_hidden_state(self):
        kept = [0.0]

        def warm(state, inputs, parameters):
            kept[0] += 1e-3
            return step(state, inputs, parameters) + kept[0]

        with pytest.raises(ssm.SimulatorError, match="keeps something between calls"):
            called(warm)

    def test_random_numbers(self):
        rng = np.random.default_rng(0)

        def noisy(state, inputs, parameters):
            return step(state, inputs, parameters) + 1e-9 * rng.standard_normal(state.shape)

        with pytest.raises(ssm.SimulatorError, match="draws random numbers"):
            called(noisy)

    def test_rows_that_depend_on_others(self):
        def mixed(state, inputs, parameters):
            new = step(state, inputs, parameters)
            return new + 1e-3 * np.roll(new, 1, axis=0)

        with pytest.raises(ssm.SimulatorError, match="does not move each point by itself"):
            called(mixed)

    def test_rows_that_depend_on_the_size_of_the_batch(self):
        def averaged(state, inputs, parameters):
            return step(state, inputs, parameters) + 1e-3 * len(state)

        with pytest.raises(ssm.SimulatorError, match="one point of a batch alone"):
            called(averaged)

    def test_arguments_that_are_written_into(self):
        def in_place(state, inputs, parameters):
            state[:] = step(state, inputs, parameters)
            inputs[:] = parameters[:] = 17.0
            return state

        np.testing.assert_array_equal(called(in_place), called(step))

    def test_one_array_that_is_handed_out_again(self):
        room = np.empty((10_000, 2))

        def reused(state, inputs, parameters):
            room[: len(state)] = step(state, inputs, parameters)
            return room[: len(state)]

        np.testing.assert_array_equal(called(reused), called(step))

    def test_nan_is_told_and_makes_the_likelihood_zero(self):
        def undefined(state, inputs, parameters):
            new = step(state, inputs, parameters)
            new[parameters[:, 0] > 1.0] = np.nan
            return new

        model = model_of(undefined)
        with pytest.warns(UserWarning, match=r"gives NaN .*k = 1.3"):
            assert ssm.log_likelihood(model, DATA, AT)[0] == -np.inf
        below = {**AT, "k": 0.9}
        known = ssm.log_likelihood(model_of(step), DATA, below)
        np.testing.assert_allclose(ssm.log_likelihood(model, DATA, below), known, rtol=1e-12)

    def test_nan_is_never_handed_to_it(self):
        def strict(state, inputs, parameters):
            assert np.isfinite(state).all()
            new = step(state, inputs, parameters)
            new[new[:, 0] > 0.2] = np.nan
            return new

        with (
            pytest.warns(UserWarning, match="gives NaN for q, v at row"),
            pytest.raises(ssm.SamplingError, match="nan at t=2"),
        ):
            particles(strict, 50)


class TestOtherProcesses:
    def test_by_name(self):
        assert pickle.loads(pickle.dumps(spring)) is spring

    def test_draws_are_those_of_threads(self):
        model = model_of(spring)
        settings = {"draws": 20, "warmup": 20, "chains": 2, "seed": 3, "progress": False}
        here = ssm.sample(model, DATA, **settings)
        with ProcessPoolExecutor(1) as pool:
            there = ssm.sample(model, DATA, executor=pool, **settings)
        np.testing.assert_array_equal(here["posterior"]["k"], there["posterior"]["k"])

    def test_what_cannot_be_sent_is_told(self):
        lock = threading.Lock()  # no lock travels

        def locked(state, inputs, parameters):
            with lock:
                return step(state, inputs, parameters)

        model, options = model_of(locked), {"draws": 5, "warmup": 5, "chains": 1}
        with ProcessPoolExecutor(1) as pool, pytest.raises(ssm.SSMError, match="lock"):
            ssm.sample(model, DATA, executor=pool, progress=False, **options)


def test_what_the_function_reads_may_change_between_calls():
    """Values are kept within a pass of a diagnosis only: a constant that is changed counts."""
    constants = {"g": 1.0}

    def moved(state, inputs, parameters):
        q, v = state.T
        v = v + 0.1 * (inputs[:, 0] - constants["g"] * parameters[:, 0] * q)
        return np.stack([q + 0.1 * v, v], axis=1)

    model = model_of(ssm.simulator(state=["q", "v"], inputs=["u"], parameters=["k"])(moved))
    first = ssm.log_likelihood(model, DATA, AT, proposal="extended")
    constants["g"] = 2.0
    assert ssm.log_likelihood(model, DATA, AT, proposal="extended") != first
    constants["g"] = 1.0
    assert ssm.log_likelihood(model, DATA, AT, proposal="extended") == first
