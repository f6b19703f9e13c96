"""`integrate` against SciPy's solver and exact solutions, and what it refuses."""

import numpy as np
import pytest
from scipy import linalg
from scipy.integrate import solve_ivp

import ssmppl as ssm
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import symbol, topological
from ssmppl.expressions.loops.affine import affine_form

Q, V = symbol("state_prev", "q"), symbol("state_prev", "v")
K, D = symbol("parameter", "k"), symbol("parameter", "d")
U, DT = symbol("input", "u"), symbol("input", "dt")
AT = {Q: 0.5, V: -1.0, K: 9.0, D: 0.4, U: 0.7, DT: 0.37}
ORDERS = {"euler": 1, "semi-implicit": 1, "midpoint": 2, "heun": 2, "rk4": 4, "implicit": 2}


def swing(q, v):
    return {"q": v, "v": U - K * np.sin(q) - D * v}


def exact(dt):
    found = solve_ivp(
        lambda t, x: [x[1], 0.7 - 9.0 * np.sin(x[0]) - 0.4 * x[1]], (0.0, dt), [0.5, -1.0],
        rtol=1e-12, atol=1e-13,
    )  # fmt: skip
    return found.y[:, -1]


@pytest.mark.parametrize("method", ORDERS)
def test_each_method_converges_at_its_order(method):
    expected = exact(0.37)
    errors = []
    for steps in (20, 40):
        new = ssm.integrate(swing, {"q": Q, "v": V}, DT, method=method, steps=steps)
        errors.append(np.abs(evaluate(list(new.values()), AT) - expected).max())
    assert errors[0] / errors[1] == pytest.approx(2.0 ** ORDERS[method], rel=0.15)
    assert errors[1] < {1: 0.03, 2: 1e-3, 4: 1e-7}[ORDERS[method]]


def test_semi_implicit_steps_keep_the_energy():
    new = ssm.integrate(
        lambda q, v: {"q": v, "v": -np.sin(q)}, {"q": Q, "v": V}, 200.0, method="semi-implicit",
        steps=2000,
    )  # fmt: skip
    q, v = evaluate(list(new.values()), AT)
    assert 0.5 * v**2 - np.cos(q) == pytest.approx(0.5 - np.cos(0.5), abs=0.06)


def test_implicit_steps_do_not_blow_up():
    def stiff(x):
        return -1e4 * (x - np.cos(x))

    new = evaluate(ssm.integrate(stiff, Q, 1.0, method="implicit", steps=20), AT)
    assert new == pytest.approx(0.7390851332, abs=1e-4)
    with np.errstate(over="ignore", invalid="ignore"):
        assert not abs(evaluate(ssm.integrate(stiff, Q, 1.0, steps=20), AT)) < 1.0


@pytest.mark.parametrize("method", ORDERS)
def test_linear_equations_are_solved_exactly(method):
    def spring(q, v):
        return {"q": v, "v": U * D - K * q - D * v}

    new = ssm.integrate(spring, {"q": Q, "v": V}, DT, method=method)
    m = np.array([[0.0, 1.0, 0.0], [-9.0, -0.4, 0.28], [0.0, 0.0, 0.0]])
    expected = linalg.expm(0.37 * m)[:2] @ [0.5, -1.0, 1.0]
    np.testing.assert_allclose(evaluate(list(new.values()), AT), expected, rtol=1e-12)
    assert affine_form(list(new.values()), [Q, V, U]) is not None


def test_forms_of_a_state():
    scalar = ssm.integrate(lambda x: -K * x, Q, 0.5)
    assert evaluate(scalar, AT) == pytest.approx(0.5 * np.exp(-4.5), rel=1e-14)
    matrix = np.array([[0.0, 1.0], [-2.0, -0.3]])
    vector = ssm.integrate(lambda x: matrix @ x, np.stack([Q, V]), 0.5)
    np.testing.assert_allclose(
        evaluate(vector, AT), linalg.expm(0.5 * matrix) @ [0.5, -1.0], rtol=1e-13
    )
    mixed = {"pair": np.stack([Q, V]), "one": Q}
    new = ssm.integrate(
        lambda s: {"one": s["pair"][1] * s["one"], "pair": s["pair"] ** 2}, mixed, 0.1, steps=50
    )
    assert {n: np.shape(v) for n, v in new.items()} == {"pair": (2,), "one": ()}
    x0 = np.array([0.5, -1.0])
    np.testing.assert_allclose(evaluate(new["pair"], AT), x0 / (1 - 0.1 * x0), rtol=1e-9)
    numbers = ssm.integrate(lambda x: x - x**3, np.array([0.1, 2.0]), 0.2, steps=3)
    assert numbers.dtype == float
    single = ssm.integrate(lambda q, v: [v, -np.sin(q)], {"q": Q, "v": V}, 0.1)
    assert list(single) == ["q", "v"]


@pytest.mark.parametrize("method", ORDERS)
@pytest.mark.parametrize("steps", [1, 3])
def test_of_numbers_there_are_numbers(method, steps):
    def swing(q, v):
        return {"q": v, "v": 0.7 - 9.0 * np.sin(q) - 0.4 * v}

    begin = {"q": 0.5, "v": -1.0}
    found = ssm.integrate(swing, begin, 0.37, method=method, steps=steps)
    traced = ssm.integrate(swing, {"q": Q, "v": V}, 0.37, method=method, steps=steps)
    assert all(isinstance(e, float) for e in found.values())
    np.testing.assert_allclose(
        list(found.values()), evaluate(list(traced.values()), AT), rtol=1e-13
    )
    matrix = np.array([[0.0, 1.0], [-2.0, -0.3]])
    assert ssm.expm(matrix).dtype == float
    np.testing.assert_allclose(ssm.expm(matrix), linalg.expm(matrix), rtol=1e-14)


def test_one_step_and_a_hundred_are_as_long():
    def length(steps):
        new = ssm.integrate(swing, {"q": Q, "v": V}, 0.5, steps=steps)
        return len(topological(list(new.values())))

    assert length(2) == length(100)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: ssm.integrate(swing, {"q": Q, "v": V}, 1.0, method="rk5"), "no method 'rk5'"),
        (lambda: ssm.integrate(swing, {"q": Q, "v": V}, 1.0, steps=0), "steps=0"),
        (lambda: ssm.integrate(swing, {"q": Q, "v": V}, 1.0, steps=2.0), "steps=2.0"),
        (lambda: ssm.repeat(lambda x: x, Q, -1), "times=-1"),
        (lambda: ssm.integrate(lambda q, v: {"q": v}, {"q": Q, "v": V}, 1.0), "gives q of a state"),
        (lambda: ssm.integrate(lambda x: np.stack([x, x]), Q, 1.0), "shapes"),
        (lambda: ssm.integrate(lambda x: x > 0.0, Q, 1.0), "condition"),
        (lambda: ssm.expm(np.stack([Q, V])), "shape"),
        (lambda: ssm.integrate(lambda q: np.floor(q) * q, Q, 1.0, method="implicit"), None),
    ],
)
def test_what_is_refused(call, said):
    if said is None:
        call()
        return
    with pytest.raises(ssm.ModelError, match=said) as error:
        call()
    assert "test_integrate.py" in str(error.value)
