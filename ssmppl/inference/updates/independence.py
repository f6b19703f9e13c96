"""Chains whose proposals do not depend on where they stand, so that many are looked at together.

Metropolis-Hastings with proposals from a multivariate t distribution that is fitted to the
posterior (an independence sampler; Tierney 1994, section 2.3.3): first round the mode, with the
inverse information, then by the weighted moments of draws from it (adaptive importance sampling;
Oh and Berger 1992). As proposals are independent, their likelihoods are computed in batches, and
trajectories likewise for all draws that are kept.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from scipy.special import gammaln

from ssmppl.errors import ArgumentError
from ssmppl.inference.batched.extended import Extended
from ssmppl.inference.optimisation.batched_newton import climb_together
from ssmppl.inference.optimisation.parts import Parts, parts_of, summed
from ssmppl.inference.run.draws import Block
from ssmppl.inference.run.problem import Problem

DEGREES = 5.0  # of freedom: tails heavier than a posterior's
WIDER = 1.1  # than the fitted scale
FITTED, ROUNDS = 256, 3  # draws behind a fit of the proposal, and fits
ENOUGH = 40.0  # effective draws from which moments are taken
AHEAD = 128  # steps that are made together
ROUND_START, SPREAD, CLIMBS = 47, 2.0, 3  # points looked at for a start, their spread, climbs
PREPARING = 25  # passes over the data before the chains begin, most often
LEAST = 1e-8  # of an eigenvalue of the proposal's scale, as a correlation
BURNT = 50  # steps of the warmup that are made: starts are drawn from the fitted posterior


class Space(Protocol):
    """The free parameters on their unconstrained scale, as of `preparation/space.py`."""

    @property
    def problem(self) -> Problem: ...
    @property
    def z(self) -> np.ndarray: ...
    @property
    def positions(self) -> np.ndarray: ...

    def parameters(self, point: np.ndarray, /) -> tuple[np.ndarray, float]: ...


@dataclass(frozen=True)
class Fitted:
    """The proposal: centre (F,), factor (F, F) of its scale. ess : effective draws of `FITTED`."""

    centre: np.ndarray
    factor: np.ndarray
    ess: float

    def draw(self, rng: np.random.Generator) -> np.ndarray:
        """(F,)."""
        normals = rng.standard_normal(len(self.centre))
        stretch = np.sqrt(DEGREES / rng.chisquare(DEGREES))
        return self.centre + (self.factor @ normals) * stretch

    def log_density(self, z: np.ndarray) -> np.ndarray:
        """(B,) at z (B, F)."""
        f = len(self.centre)
        e = np.linalg.solve(self.factor, (z - self.centre).T) if f else np.zeros((0, len(z)))
        size = np.sum(e**2, axis=0)
        constant = gammaln(0.5 * (DEGREES + f)) - gammaln(0.5 * DEGREES)
        constant -= 0.5 * f * np.log(DEGREES * np.pi) + np.linalg.slogdet(self.factor)[1]
        density: np.ndarray = constant - 0.5 * (DEGREES + f) * np.log1p(size / DEGREES)
        return density


@dataclass(frozen=True)
class Standing:
    """Where a chain stands, and the draws that it has made ahead.

    z (F,), theta (P,), log_target : log posterior in z, log_likelihood, log_proposal : there.
    count : draws handed out. at : of those ahead: thetas (A, P), log_likelihoods, lps, rates (A,),
    paths of each experiment (A, T, D).
    """

    z: np.ndarray
    theta: np.ndarray
    log_target: float
    log_likelihood: float
    log_proposal: float
    generator: np.random.Generator
    count: int
    at: int
    thetas: np.ndarray
    log_likelihoods: np.ndarray
    lps: np.ndarray
    rates: np.ndarray
    paths: tuple[np.ndarray, ...]


@dataclass(frozen=True)
class IndependentChains:
    """The kernel: a function of blocks, as `run_chains` takes them."""

    space: Space
    model: Extended
    proposal: Fitted
    warmup: int
    thin: int
    states: bool
    by_row: bool = False

    def start(self, generator: np.random.Generator, z: np.ndarray) -> Standing:
        """A chain from z (F,)."""
        theta, target, likelihood = targets(self.space, self.model, z[None])
        p = len(theta[0])
        nothing = np.zeros(0)
        return Standing(
            z, theta[0], float(target[0]), float(likelihood[0]),
            float(self.proposal.log_density(z[None])[0]), generator, 0, 0, np.zeros((0, p)),
            nothing, nothing, nothing, (),
        )  # fmt: skip

    def step_block(self, state: Standing, n: int) -> tuple[Standing, Block]:
        """n draws."""
        parts: dict[str, list[Any]] = {}
        while n:
            waiting = max(self.warmup - BURNT - state.count, 0)
            if waiting:  # of the warmup only the end
                k = min(n, waiting)
                own = self._repeated(state, k)
                state = replace(state, count=state.count + k)
            else:
                if state.at == len(state.thetas):
                    state = self._ahead(state)
                k = min(n, len(state.thetas) - state.at)
                rows = slice(state.at, state.at + k)
                own = {
                    "theta": state.thetas[rows], "log_likelihood": state.log_likelihoods[rows],
                    "lp": state.lps[rows], "acceptance_rate": state.rates[rows],
                    **{f"path_{i}": path[rows] for i, path in enumerate(state.paths)},
                    **self._increments(state.thetas[rows]),
                }  # fmt: skip
                state = replace(state, at=state.at + k, count=state.count + k)
            for name, values in own.items():
                parts.setdefault(name, []).append(values)
            n -= k
        whole = {name: np.concatenate(values) for name, values in parts.items()}
        stats = {k: whole.pop(k) for k in ("lp", "acceptance_rate")}
        stats["log_marginal_likelihood"] = whole.pop("log_likelihood")
        return state, Block(whole, stats)

    def _increments(self, theta: np.ndarray) -> dict[str, np.ndarray]:
        """log p(y_t | y_{1:t-1}, theta) (B, T) of each experiment at draws theta (B, P)."""
        if not self.by_row:
            return {}
        data = self.space.problem.experiments
        rows = self.model.increments(data, theta)
        ends = np.cumsum([e.steps for e in data])[:-1]
        return {f"increment_{i}": r for i, r in enumerate(np.split(rows, ends, axis=1))}

    def _repeated(self, state: Standing, k: int) -> dict[str, np.ndarray]:
        lp = state.log_target
        return {
            "theta": np.tile(state.theta, (k, 1)), "lp": np.full(k, lp),
            "log_likelihood": np.full(k, state.log_likelihood), "acceptance_rate": np.zeros(k),
        }  # fmt: skip

    def _ahead(self, state: Standing) -> Standing:
        """The next draws, all of their likelihoods and trajectories together. They end with the
        warmup, whose draws have no trajectories and are not thinned."""
        generator = copy.deepcopy(state.generator)
        left = self.warmup - state.count
        draws = min(AHEAD, left) if left > 0 else AHEAD
        steps = draws * (1 if left > 0 else self.thin)
        new = np.array([self.proposal.draw(generator) for _ in range(steps)])
        log_u = np.log(generator.uniform(size=steps))
        theta, target, likelihood = targets(self.space, self.model, new.reshape(steps, -1))
        proposed = self.proposal.log_density(new.reshape(steps, -1))
        z, here = state.z, state.theta
        values = state.log_target, state.log_likelihood, state.log_proposal
        kept: list[tuple[np.ndarray, float, float, float]] = []
        each, rate = steps // draws, 0.0
        for k in range(steps):
            ratio = target[k] - values[0] - proposed[k] + values[2]
            rate += float(np.exp(min(ratio, 0.0))) if ratio > -np.inf else 0.0
            if log_u[k] < ratio:
                z, here = new[k], theta[k]
                values = float(target[k]), float(likelihood[k]), float(proposed[k])
            if (k + 1) % each == 0:
                kept.append((here, values[1], values[0], rate / each))
                rate = 0.0
        thetas = np.array([k[0] for k in kept]).reshape(draws, -1)
        paths: tuple[np.ndarray, ...] = ()
        if self.states and left <= 0:
            paths = tuple(
                self.model.trajectories(e, thetas, generator)
                for e in self.space.problem.experiments
            )
        likelihoods, lps, rates = (np.array([k[i] for k in kept]) for i in (1, 2, 3))
        return Standing(
            z, here, *values, generator, state.count, 0, thetas, likelihoods, lps, rates, paths
        )


def targets(
    space: Space, model: Extended, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """theta (B, P), log posterior density of z (B, F) and log-likelihood, (B,) each; -inf for
    none."""
    theta, parts = _parts(space, model, z)
    total = summed(parts)
    rows = parts.rows
    likelihood = np.where(rows[:, -1] > -np.inf, rows[:, :-1].sum(axis=1), -np.inf)
    return theta, total, likelihood


def _parts(space: Space, model: Extended, z: np.ndarray) -> tuple[np.ndarray, Parts]:
    """theta (B, P), and the parts of the log posterior density."""
    found = [(t.copy(), log_prior) for t, log_prior in map(space.parameters, z)]
    theta = np.array([t for t, _ in found]).reshape(len(z), -1)
    prior, data = np.array([p for _, p in found]), space.problem.experiments
    return theta, parts_of(partial(model.increments_and_predictions, data), theta, prior)


def mode_of(space: Space, model: Extended, rng: np.random.Generator) -> Any:
    """The highest mode of the posterior of z that climbs from points round the start come to.

    Raises
    ------
    ArgumentError : there is no density at any of them.
    """
    z = space.z[space.positions]

    def density(points: np.ndarray) -> Parts:
        return _parts(space, model, points)[1]

    points = np.vstack([z, z + SPREAD * rng.standard_normal((ROUND_START, len(z)))])
    found = climb_together(density, points[np.argsort(-summed(density(points)))[:CLIMBS]])
    if found is None:
        raise ArgumentError(
            "the extended Kalman filter is not finite (NaN or infinite) at every point tried",
            fix="give start={name: value} near plausible values, or look whether the simulator "
            "gives NaN",
        )
    return found.top


def fitted(
    space: Space, model: Extended, rng: np.random.Generator
) -> tuple[Fitted, np.ndarray, np.ndarray]:
    """The proposal, and draws (N, F) from it with their weights (N,)."""
    top = mode_of(space, model, rng)
    proposal = Fitted(top.z, factor_of(_inverse(top.information)), 0.0)
    for last in range(ROUNDS):
        z = np.array([proposal.draw(rng) for _ in range(FITTED)]).reshape(FITTED, -1)
        log_w = targets(space, model, z)[1] - proposal.log_density(z)
        w = np.exp(log_w - np.max(log_w))
        w /= w.sum()
        ess = float(1.0 / np.sum(w**2))
        proposal = replace(proposal, ess=ess)
        if last + 1 == ROUNDS or ess > 0.6 * FITTED:
            break
        if ess < ENOUGH:  # too few to go by: wider
            proposal = replace(proposal, factor=1.3 * proposal.factor)
            continue
        centre = w @ z
        off = z - centre
        covariance = (w[:, None] * off).T @ off
        proposal = Fitted(centre, factor_of(covariance), ess)
    return proposal, z, w


def factor_of(covariance: np.ndarray) -> np.ndarray:
    """(F, F) lower factor of the scale of the proposal for a posterior of this covariance."""
    if not len(covariance):
        return covariance
    scale = np.sqrt(np.maximum(np.diagonal(covariance), 1e-300))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    values = np.maximum(values, LEAST)
    whole = (vectors * values) @ vectors.T * np.outer(scale, scale)
    found: np.ndarray = WIDER * np.linalg.cholesky(whole)
    return found


def _inverse(information: np.ndarray) -> np.ndarray:
    """The inverse of an information that need not be positive definite: eigenvalues count by their
    size."""
    if not len(information):
        return information
    scale = np.sqrt(np.maximum(np.abs(np.diagonal(information)), 1e-10))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    values = np.maximum(np.abs(values), 1e-3)
    found: np.ndarray = (vectors / values) @ vectors.T / np.outer(scale, scale)
    return found


def independent_chains(
    space: Space, model: Extended, streams: Callable[[int], np.random.Generator], chains: int,
    rng: np.random.Generator, warmup: int, thin: int, states: bool, by_row: bool = False,
) -> tuple[IndependentChains, list[Standing], dict[str, Any]]:  # fmt: skip
    """The kernel, where its chains start, and what to report.

    streams : the random numbers of each chain. rng : those of the fit. by_row : whether draws come
    with the log-likelihood of each row.
    """
    proposal, z, w = fitted(space, model, rng)
    kernel = IndependentChains(space, model, proposal, warmup, thin, states, by_row)
    begun = z[rng.choice(len(z), size=chains, p=w)]
    standing = [kernel.start(streams(i), begun[i]) for i in range(chains)]
    report = {
        "proposals": "independent, from a t distribution fitted to the posterior",
        "proposal_ess_share": proposal.ess / FITTED,
    }
    return kernel, standing, report
