"""The exact conditional of an update, from the model's guarded densities by the interpreter."""

import numpy as np
from scipy import stats

from ssmppl.analysis.conjugacy import numerical_check
from ssmppl.analysis.conjugacy.matrix_families import lower_half
from ssmppl.analysis.density import terms
from ssmppl.analysis.lambdify import DOMAIN, python_function
from ssmppl.expressions.evaluate import evaluate
from ssmppl.expressions.expr import constant, substitute, symbols_of
from ssmppl.inference.updates.draw_update import draw, sampler_of


class Conditional:
    """Everything about one update at one random data set and point of the other parameters."""

    def __init__(self, data, update, series, k=0):
        self.update = update
        self.rows = [{s: float(v[k]) for s, v in values.items()} for values in series]
        self.rest = {s: v for s, v in self.rows[0].items() if s.data[0] == "parameter"}
        self.current = np.array([self.rest[c] for c in update.components])
        self.totals = np.array(
            [
                sum(
                    float(evaluate(update.coefficients[role][i], row))
                    for role in update.coefficients
                    for t, row in enumerate(self.rows)
                    if numerical_check._counts(role, t)
                )
                for i in range(len(update.functions))
            ]
        )
        self.log_density = self._joint(data)
        function = python_function([self.log_density], update.components)

        def log_joint(v):
            try:
                value = function(np.asarray(v).tolist())[0]
            except DOMAIN:
                return -np.inf
            return value if value == value else -np.inf

        self.log_joint = log_joint

    def _joint(self, data):
        block = frozenset(self.update.components)
        total = constant(0.0)
        for role in ("prior", "initial", "transition", "observation"):
            for term in terms(data.trace, role):
                density = term.guarded()
                if not symbols_of(density) & block:
                    continue
                for t, row in enumerate(self.rows):
                    if numerical_check._counts(role, t):
                        numbers = {s: constant(v) for s, v in row.items() if s not in block}
                        total = total + substitute([density], numbers)[0]
        return total

    def draws(self, n, rng, thin=1):
        out, infos, value = [], [], self.current
        for _ in range(n):
            for _ in range(thin):
                value, info = draw(self.update, self.totals, value, self.rest, rng, self.log_joint)
            out.append(value)
            infos.append(info)
        return np.array(out), infos

    def density(self, points):
        """Unnormalised density at points, (dimension, n)."""
        logs = self.log_density_at(points).copy()
        logs[np.isnan(logs)] = -np.inf
        return np.exp(logs - logs.max())

    def log_density_at(self, points):
        """Log density, up to a constant, at points (dimension, n)."""
        values = dict(zip(self.update.components, points, strict=True))
        return np.broadcast_to(evaluate(self.log_density, values), np.shape(points)[1:])

    # -- quadrature on an unconstrained grid
    def coordinates(self, draws):
        """(draws on an unconstrained scale, function back to values, log Jacobian)."""
        kind = self.update.kind
        if kind == "matrix":
            return self._matrix_coordinates(draws)
        if kind == "simplex":
            z = np.log(draws[:, :-1] / draws[:, -1:]).T

            def back(z):
                p = np.exp(np.concatenate([z, np.zeros((1, *z.shape[1:]))]))
                return p / p.sum(0)

            return z, back, lambda v: np.log(v).sum(0)
        limits = sampler_of(self.update).limits(self.rest)
        ends = [
            (max(a, n[0]), min(b, n[1]))
            for (a, b), n in zip(limits, sampler_of(self.update).natural, strict=True)
        ]
        return self._real_coordinates(draws, ends)

    def _real_coordinates(self, draws, ends):
        def transform(v, a, b):
            if np.isfinite(a) and np.isfinite(b):
                return np.log((v - a) / (b - v))
            if np.isfinite(a):
                return np.log(v - a)
            return -np.log(b - v) if np.isfinite(b) else v

        def inverse(z, a, b):
            if np.isfinite(a) and np.isfinite(b):
                return a + (b - a) / (1 + np.exp(-z))
            if np.isfinite(a):
                return a + np.exp(z)
            return b - np.exp(-z) if np.isfinite(b) else z

        def log_slope(v, a, b):
            if np.isfinite(a) and np.isfinite(b):
                return np.log(v - a) + np.log(b - v)
            if np.isfinite(a):
                return np.log(v - a)
            return np.log(b - v) if np.isfinite(b) else np.zeros_like(v)

        z = np.array([transform(d, *e) for d, e in zip(draws.T, ends, strict=True)])
        return (
            z,
            lambda z: np.array([inverse(x, *e) for x, e in zip(z, ends, strict=True)]),
            lambda v: sum(log_slope(x, *e) for x, e in zip(v, ends, strict=True)),
        )

    def _matrix_coordinates(self, draws):
        """The Cholesky factor, its diagonal by the log: dP = 2^p prod_i L_ii^(p + 1 - i) d(...)."""
        size = matrix_size(draws.shape[1])
        cells = lower_half(size)
        roots = np.linalg.cholesky(matrices(draws, size))
        z = np.array([np.log(roots[:, i, j]) if i == j else roots[:, i, j] for i, j in cells])

        def back(z):
            root = np.zeros((size, size, z.shape[1]))
            for row, (i, j) in zip(z, cells, strict=True):
                root[i, j] = np.exp(row) if i == j else row
            full = np.einsum("ikn,jkn->ijn", root, root)
            return np.array([full[c] for c in cells])

        def log_jacobian(v):
            roots = np.linalg.cholesky(matrices(v.T, size))
            powers = size + 1 - np.arange(size)
            return np.log(np.diagonal(roots, axis1=1, axis2=2)) @ powers

        return z, back, log_jacobian

    def grid(self, draws):
        """(values (d, n), weights (n,)) of a grid that reaches far past the draws."""
        z, back, log_jacobian = self.coordinates(draws)
        d = len(z)
        low, high = z.min(1), z.max(1)
        reach = 0.6 * (high - low) + 1e-9
        n = {1: 6000, 2: 420, 3: 60}[d]
        axes = [np.linspace(a - r, b + r, n) for a, b, r in zip(low, high, reach, strict=True)]
        points = np.array(np.meshgrid(*axes, indexing="ij")).reshape(d, -1)
        with np.errstate(all="ignore"):
            values = back(points)
            weights = self.density(values) * np.exp(log_jacobian(values))
        weights[~np.isfinite(weights)] = 0.0
        return values, weights / weights.sum()


def matrix_size(components):
    return round((np.sqrt(8 * components + 1) - 1) / 2)


def matrices(draws, size):
    out = np.empty((len(draws), size, size))
    for column, (i, j) in zip(draws.T, lower_half(size), strict=True):
        out[:, i, j] = out[:, j, i] = column
    return out


def kolmogorov_smirnov(sample, values, weights):
    """p value of a sample against a discretised law."""
    points, place = np.unique(values, return_inverse=True)  # of a grid, many share a coordinate
    mass = np.bincount(place, weights)
    cdf = np.cumsum(mass) - 0.5 * mass
    return stats.kstest(np.interp(sample, points, cdf), "uniform").pvalue
