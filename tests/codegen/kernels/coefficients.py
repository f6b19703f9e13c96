"""The polynomials of `ssmppl.codegen.kernels.math.elementary`, computed anew with mpmath.

Each is the interpolant of a smooth function at the Chebyshev nodes of its interval,
which is within a small factor of the best approximation.
`python -m tests.codegen.kernels.coefficients` prints them.
"""

from __future__ import annotations

import mpmath as mp

TERMS = 80  # of the power series below, more than 50 digits need


def interpolant(f, low, high, degree):
    """Coefficients, constant term first, of the interpolant of f at the Chebyshev nodes."""
    n = degree + 1
    middle, half = (low + high) / 2, (high - low) / 2
    nodes = [middle + half * mp.cos(mp.pi * (2 * i + 1) / (2 * n)) for i in range(n)]
    matrix = mp.matrix(n, n)
    values = mp.matrix(n, 1)
    for i, x in enumerate(nodes):
        values[i] = f(x)
        for j in range(n):
            matrix[i, j] = x**j
    return [float(c) for c in mp.lu_solve(matrix, values)]


def table():
    """Name of each polynomial -> its coefficients."""
    with mp.workdps(60):
        half_log2 = mp.log(2) / 2
        log_end = ((mp.sqrt(2) - 1) / (mp.sqrt(2) + 1)) ** 2
        margin = mp.mpf("1.001")
        trig_end = (mp.pi / 4) ** 2 * margin
        atan_end = (mp.sqrt(2) - 1) ** 2 * margin

        def exp_rest(r):  # exp r = 1 + r + r^2 (...)
            return sum(r**k / mp.factorial(k + 2) for k in range(TERMS))

        def log_rest(z):  # 2 atanh s = 2 s + s z (...), z = s^2
            return 2 * sum(z**k / (2 * k + 3) for k in range(TERMS))

        def sin_rest(z):  # sin x = x + x z (...), z = x^2
            return sum((-1) ** (k + 1) * z**k / mp.factorial(2 * k + 3) for k in range(TERMS))

        def cos_rest(z):  # cos x = 1 - z/2 + z^2 (...)
            return sum((-1) ** k * z**k / mp.factorial(2 * k + 4) for k in range(TERMS))

        def atan_rest(z):  # atan x = x + x z (...)
            return sum((-1) ** (k + 1) * z**k / (2 * k + 3) for k in range(2 * TERMS))

        zero = mp.mpf(0)
        return {
            "exp": interpolant(exp_rest, -half_log2, half_log2, 9),
            "log": interpolant(log_rest, zero, log_end, 6),
            "sin": interpolant(sin_rest, zero, trig_end, 5),
            "cos": interpolant(cos_rest, zero, trig_end, 5),
            "arctan": interpolant(atan_rest, zero, atan_end, 10),
        }


if __name__ == "__main__":
    for name, coefficients in table().items():
        print(name, coefficients)
