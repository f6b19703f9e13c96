"""How much of the gap an effect closes on rows that took no part in fitting or choosing it.

The gain ratio is F = sum_t (l_kt - l_0t) / sum_t (l_Ct - l_0t), l the one-step log predictive
densities of the base model (0), the model with the effect (k) and the reference (C). Numerator and
denominator are sums over the same dependent rows: their 2 x 2 covariance comes from a paired
circular block bootstrap (Politis and Romano 1992), and the confidence set of the ratio from
Fieller's theorem (E. Fieller 1954), which says so where the denominator could be zero.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from scipy.special import stdtrit

from ssmppl.data import Experiment
from ssmppl.diagnosis.effects.candidate import WHOLE, segments
from ssmppl.diagnosis.fitting.augmented_models import AugmentedModels
from ssmppl.diagnosis.fitting.fit import Fit, Fitter
from ssmppl.diagnosis.heldout.predictions import FreeRun, free_run, gain_of_mean, predict, rmse
from ssmppl.diagnosis.heldout.reference import fit_reference
from ssmppl.diagnosis.heldout.row_split import RowSplit
from ssmppl.diagnosis.heldout.simulation import FREE_RUN, compared, horizons, table_rows
from ssmppl.diagnosis.run.checkpoint import Checkpoint
from ssmppl.diagnosis.screening.screen import Screen
from ssmppl.diagnosis.selection.horizons import SimulationGain
from ssmppl.diagnosis.selection.refit import Refit
from ssmppl.diagnosis.selection.simulation_fit import fit_for_simulation
from ssmppl.errors import ArgumentError, SSMError

REPLICATES = 2000  # of the bootstrap
LEAST_CHOSEN = 10  # blocks that the choice of their length leaves
FEWEST_BLOCKS = 5  # below which the bootstrap does not know a variance
SAME = 1e-3  # relative difference of two gains up to which they are the same model's
NOT_GIVEN = "the share of the reference model's gain could not be computed: {}"

Kind = Literal["bounded", "complement", "unbounded"]


@dataclass(frozen=True)
class ConfidenceSet:
    """Confidence set of a ratio: [low, high], all but (low, high), or every number."""

    kind: Kind
    low: float
    high: float

    def holds(self, value: float) -> bool:
        """Whether the set holds this value."""
        if self.kind == "unbounded":
            return True
        return (self.low <= value <= self.high) == (self.kind == "bounded")


@dataclass(frozen=True)
class Gain:
    """Log predictive density gained over the base model, in nats, with its standard error.

    nats_per_sample : over the rows with data.
    """

    nats: float
    error: float
    nats_per_sample: float


@dataclass(frozen=True)
class GainRatio:
    """Share of the gap that is closed, with its confidence set.

    F, low, high : NaN where the gap is not measurable; `reason` then says why, else it is "".
    gain, reference : numerator and denominator. covariance : (2, 2) of their two sums.
    block : rows per block. blocks : how many of them. level : of the interval.
    """

    F: float
    low: float
    high: float
    gain: Gain
    reference: Gain
    covariance: np.ndarray
    block: int
    blocks: float
    level: float
    reason: str = ""

    @property
    def measurable(self) -> bool:
        """Whether the reference gains more than nothing, as far as these rows tell."""
        return not self.reason

    @property
    def own_reference(self) -> bool:
        """Whether the reference is the chosen model itself, so that the ratio compares nothing."""
        return abs(self.gain.nats - self.reference.nats) <= SAME * abs(self.reference.nats)

    @property
    def interval(self) -> tuple[float, float]:
        """The interval of the ratio; NaN where it compares a model with itself."""
        return (np.nan, np.nan) if self.own_reference else (self.low, self.high)

    def notes(self, chosen: bool) -> list[str]:
        """What has to be known beside the ratio. chosen : whether an effect was."""
        if self.reason:
            return [self.reason]
        if not self.own_reference:
            return []
        low, high = (self.gain.nats + s * 1.96 * self.gain.error for s in (-1.0, 1.0))
        what = "the reference model equals the chosen model"
        if not chosen:
            what = "no effect was chosen, and the reference model is compared with itself"
        return [
            f"{what}, so that the share is 100% by construction; its held-out gain is "
            f"{self.gain.nats:.1f} nats (95% interval {low:.1f} to {high:.1f})"
        ]


def gain_ratio(
    base: np.ndarray,
    effect: np.ndarray,
    reference: np.ndarray,
    *,
    block: int | None = None,
    starts: Sequence[int] = WHOLE,
    noise: Sequence[float] | None = None,
    level: float = 0.95,
    replicates: int = REPLICATES,
    seed: int = 1,
) -> GainRatio:
    """F with its interval from one-step log predictive densities.

    Parameters
    ----------
    base, effect, reference : (T,), or (R, T) from R independent runs of the particle filter, run r
        of each with the same seed. Missing rows are 0 in all three. Rows may also be whole blocks
        (the folds of a cross-validation): then give `block=1`.
    block : rows per block; None: chosen by `block_length`.
    starts : first row of each experiment; no block reaches across.
    noise : Monte Carlo sd of the three totals, where there is one run only. With R >= 2 runs it
        comes from their spread.

    Raises
    ------
    ArgumentError : shapes that differ, a value that is not finite, fewer than `FEWEST_BLOCKS`
        blocks.
    """
    l0, lk, lc = _runs(base, "base"), _runs(effect, "effect"), _runs(reference, "reference")
    if not l0.shape == lk.shape == lc.shape:
        raise ArgumentError(
            f"log predictive densities of shapes {l0.shape}, {lk.shape} and {lc.shape}",
            fix="give the three models the same rows and the same number of runs",
        )
    gains = np.stack([lk - l0, lc - l0])  # (2, R, T)
    rows = gains.shape[-1]
    mean = gains.mean(axis=1)
    length = block_length(mean, starts) if block is None else int(block)
    blocks = sum(max((s.stop - s.start) / length, 1.0) for s in segments(rows, starts))
    if length < 1 or blocks < FEWEST_BLOCKS:
        raise ArgumentError(
            f"{rows} rows make {blocks:.1f} blocks of {length}",
            fix=f"keep at least {FEWEST_BLOCKS} blocks of rows to confirm on, or state a shorter "
            "block=",
        )
    rng = np.random.default_rng(seed)
    covariance = _lengthened(mean, length, starts, replicates, rng)
    covariance *= blocks / (blocks - 1.0)  # deviations are from the blocks' own mean
    covariance += _run_covariance(gains, noise)
    total = mean.sum(axis=1)
    q = float(stdtrit(blocks - 1.0, 0.5 + 0.5 * level))
    error = np.sqrt(np.diagonal(covariance))
    with_data = np.any(np.concatenate([l0, lk, lc]) != 0.0, axis=0)
    samples = max(int(with_data.sum()), 1)
    gain = [Gain(float(v), float(e), float(v) / samples) for v, e in zip(total, error, strict=True)]
    low = total[1] - q * error[1]
    if not low > 0.0:
        nan = float("nan")
        reason = (
            f"no measurable gap: held-out gain of the reference model {total[1]:.1f} nats, "
            f"{level:.0%} interval from {low:.1f}"
        )
        return GainRatio(nan, nan, nan, gain[0], gain[1], covariance, length, blocks, level,
                      reason)  # fmt: skip
    interval = fieller(float(total[0]), float(total[1]), covariance, q)
    return GainRatio(float(total[0] / total[1]), interval.low, interval.high, gain[0], gain[1],
                  covariance, length, blocks, level)  # fmt: skip


def fieller(
    numerator: float, denominator: float, covariance: np.ndarray, q: float
) -> ConfidenceSet:
    """The ratios F with |N - F D| <= q sd(N - F D), q a two-sided critical value.

    A quadratic inequality in F: its solutions are an interval where D differs from zero at this
    level, else everything but an interval, or everything.
    """
    n, d = float(numerator), float(denominator)
    (vn, c), (_, vd) = np.asarray(covariance, float) * q**2
    a, half_b, constant = d * d - vd, n * d - c, n * n - vn
    inside = half_b**2 - a * constant
    if a == 0.0 or inside < 0.0:
        # a > 0 always has the solution N / D: only rounding can say otherwise.
        return (
            ConfidenceSet("bounded", n / d, n / d)
            if a > 0.0
            else ConfidenceSet("unbounded", -np.inf, np.inf)
        )
    # The root without cancellation, and the other by the product of the two.
    far = half_b + np.copysign(np.sqrt(inside), half_b)
    roots = sorted((far / a, constant / far) if far != 0.0 else (0.0, 0.0))
    return ConfidenceSet("bounded" if a > 0.0 else "complement", roots[0], roots[1])


def block_length(gains: np.ndarray, starts: Sequence[int] = WHOLE) -> int:
    """Rows per block for gains (C, T): the longest that any of the C series asks for.

    Politis and White (2004), *Econometric Reviews* 23, for the circular bootstrap, with the
    correction of Patton, Politis and White (2009): flat-top lag window, whose width is where the
    autocorrelation becomes negligible. Experiments are taken as one series less their means. At
    least `LEAST_CHOSEN` blocks are left.
    """
    gains = np.atleast_2d(np.asarray(gains, float))
    parts = list(segments(gains.shape[-1], starts))
    centred = np.concatenate([gains[:, s] - gains[:, s].mean(1, keepdims=True) for s in parts], 1)
    most = min(centred.shape[1] // LEAST_CHOSEN, min(s.stop - s.start for s in parts) // 2)
    return max(1, min(max(_politis_white(x) for x in centred), most))


def _politis_white(x: np.ndarray) -> int:
    rows = len(x)
    run = max(5, int(np.ceil(np.sqrt(np.log10(rows)))))
    most = int(np.ceil(np.sqrt(rows))) + run
    lags = np.arange(min(most, rows - 1) + 1)
    r = np.array([np.dot(x[: rows - k], x[k:]) for k in lags]) / rows
    if r[0] <= 0.0:
        return 1
    small = np.abs(r[1:] / r[0]) < 2.0 * np.sqrt(np.log10(rows) / rows)
    quiet = [m for m in range(len(small) - run + 1) if small[m : m + run].all()]
    last = quiet[0] if quiet else int(lags[-1])
    width = min(2 * max(last, 1), int(lags[-1]))
    k = lags[: width + 1]
    window = np.clip(2.0 * (1.0 - k / width), 0.0, 1.0) * r[: width + 1]
    spectrum = window[0] + 2.0 * window[1:].sum()
    if spectrum <= 0.0:
        return 1
    g = 2.0 * np.sum(k * window)
    best = (2.0 * g**2 / (4.0 / 3.0 * spectrum**2)) ** (1.0 / 3.0) * rows ** (1.0 / 3.0)
    return int(np.clip(round(best), 1, np.ceil(min(3.0 * np.sqrt(rows), rows / 3.0))))


def _lengthened(
    gains: np.ndarray, length: int, starts: Sequence[int], replicates: int,
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """(2, 2) of the sums of gains (2, T), with what blocks of this length miss added.

    They lack the correlations that reach beyond them, to first order as much as blocks of half the
    length lack more (D. Vats and J. Flegal, *Biometrika* 109, 2022, with r = 2, c = 1/2); of that
    difference the part that makes the covariance larger is added.
    """
    found = _block_covariance(gains, length, starts, replicates, rng)
    if length == 1:
        return found
    missed = found - _block_covariance(gains, (length + 1) // 2, starts, replicates, rng)
    values, vectors = np.linalg.eigh(missed)
    return found + (vectors * np.maximum(values, 0.0)) @ vectors.T


def _block_covariance(
    gains: np.ndarray, length: int, starts: Sequence[int], replicates: int,
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    """(2, 2) of the sums of gains (2, T), both resampled by the same blocks."""
    totals = np.zeros((replicates, 2))
    for s in segments(gains.shape[1], starts):
        part = gains[:, s]
        rows = part.shape[1]
        size = min(length, rows)
        count = rows / size
        doubled = np.concatenate([np.zeros((2, 1)), np.cumsum(np.tile(part, 2), axis=1)], axis=1)
        sums = doubled[:, size : size + rows] - doubled[:, :rows]  # (2, rows) circular blocks
        centred = sums - sums.mean(axis=1, keepdims=True)
        whole = max(round(count), 1)
        drawn = centred[:, rng.integers(rows, size=(replicates, whole))].sum(axis=-1)
        totals += drawn.T * np.sqrt(count / whole)
    return totals.T @ totals / replicates


def _run_covariance(gains: np.ndarray, noise: Sequence[float] | None) -> np.ndarray:
    """(2, 2) Monte Carlo covariance of the two sums, gains (2, R, T)."""
    runs = gains.shape[1]
    if runs >= 2:
        return np.cov(gains.sum(axis=2)) / runs
    base, effect, reference = np.square([0.0, 0.0, 0.0] if noise is None else np.asarray(noise))
    return np.array([[effect + base, base], [base, reference + base]])


def _runs(values: np.ndarray, name: str) -> np.ndarray:
    found = np.atleast_2d(np.asarray(values, float))
    if found.ndim != 2 or not np.all(np.isfinite(found)):
        raise ArgumentError(
            f"the log predictive densities of the {name} model have shape {np.shape(values)}"
            + ("" if found.ndim != 2 else " and hold values that are not finite"),
            fix="give (T,) or (R, T) finite numbers, 0 for missing rows",
        )
    return found


@dataclass
class HeldOutGain:
    """Rows of the report's table, free runs of each experiment before and after, and notes.

    beyond_catalogue : what the reference gains over the best of the catalogue, chosen or not.
    curves : whether the reference has smooth functions, which predict rows that they were not
        fitted to better than the chosen model.
    simulated_beyond : the share of what it takes off the error of simulations that is left by what
        was chosen, and the lower end of the interval of how much better than that it simulates;
        None where that was not measured.
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    beyond_catalogue: Gain | None = None
    before: list[FreeRun] = field(default_factory=list)
    after: list[FreeRun] | None = None
    notes: list[str] = field(default_factory=list)
    curves: bool = False
    simulated_beyond: tuple[float, float] | None = None

    def simulate(
        self, base: tuple[Fitter, Fit], experiments: Sequence[Experiment], chosen: Refit | None,
        seed: np.random.SeedSequence,
    ) -> None:  # fmt: skip
        """Free runs of the model as it was and, where an effect was chosen, with it; base : as it
        is simulated."""
        self.before = [free_run(*base, e, seed) for e in experiments]
        if chosen is not None:
            self.after = [free_run(*chosen.simulator, e, seed) for e in experiments]

    def add(
        self, label: str, ratio: GainRatio, nats_per_sample: float, gain_mean: float,
        errors: tuple[float, float], chosen: bool,
    ) -> None:  # fmt: skip
        """A row of the table and its notes. errors : of the free runs before and after."""
        low, high = ratio.interval
        self.rows.append({
            "effect": label, "horizon": FREE_RUN, "F": ratio.F, "F_low": low, "F_high": high,
            "nats_per_sample": nats_per_sample, "gain_mean": gain_mean,
            "gain_noise": ratio.gain.nats - gain_mean,
            "rmse_before": errors[0], "rmse_after": errors[1],
            "share": 1.0 - errors[1] / errors[0] if errors[0] > 0.0 else np.nan,
        })  # fmt: skip
        self.notes += ratio.notes(chosen)


@dataclass(frozen=True)
class HeldOutRows:
    """The gain on held-out rows: what it is measured with.

    base : the model's fitter and fit. chosen : None where no effect was, and the reference stands
    for it. best_refit : chosen or not. simulator, simulation : the base model as it is simulated,
    and what that is measured by. horizon : rows of the windows that are simulated; None: a tenth of
    the record.
    """

    augmented: AugmentedModels
    split: RowSplit
    base: tuple[Fitter, Fit]
    screen: Screen
    chosen: Refit | None
    best_refit: Refit | None
    simulator: tuple[Fitter, Fit]
    simulation: SimulationGain | None = None
    horizon: int | None = None

    def gain(self, label: str, seed: np.random.SeedSequence, checkpoint: Checkpoint) -> HeldOutGain:
        """The chosen model, or else the reference itself, against the base model."""
        out = HeldOutGain()
        out.simulate(self.simulator, self.split.experiments, self.chosen, seed)
        try:
            self._measure(out, label, seed, checkpoint)
        except SSMError as error:  # a held-out row may be impossible under what others were fit to
            out.notes.append(NOT_GIVEN.format(error.found))
        return out

    def _measure(
        self, out: HeldOutGain, label: str, seed: np.random.SeedSequence, checkpoint: Checkpoint
    ) -> None:
        """The gain ratio, and what the reference gains beyond the catalogue, into `out`.

        Raises
        ------
        SSMError : a model cannot predict the held-out rows, or there are too few.
        """
        chosen, experiments, counts = self.chosen, self.split.experiments, self.split.held_out
        over = checkpoint.executor
        plain = predict(*self.base, experiments, counts, seed, over)
        try:
            reference = fit_reference(
                self.augmented, chosen.candidates if chosen else (),
                chosen.fit if chosen else self.base[1], self.screen, self.split.train, seed,
                checkpoint, self.split,
            )  # fmt: skip
            best = predict(*reference, experiments, counts, seed, over)
        except SSMError as error:
            out.notes.append(f"the reference model could not be fitted: {error.found}")
            return
        model = (chosen.fitter, chosen.fit) if chosen else reference
        same = reference[1] is model[1]  # nothing was found beyond the chosen effects
        out.curves = reference[1] is not (chosen.fit if chosen else self.base[1])
        found = best if same else predict(*model, experiments, counts, seed, over)
        ratio = gain_ratio(
            plain.log_density, found.log_density, best.log_density, starts=plain.starts
        )
        rival, other = found, self.best_refit
        if chosen is None:
            rival = plain
            if other is not None:
                rival = predict(other.fitter, other.fit, experiments, counts, seed, over)
        out.beyond_catalogue = gain_ratio(
            rival.log_density, best.log_density, best.log_density, starts=plain.starts
        ).gain
        after = out.after or [free_run(*model, e, seed) for e in experiments]
        before_error, after_error = (rmse(r, experiments, counts) for r in (out.before, after))
        out.add(
            label, ratio, ratio.gain.nats_per_sample, gain_of_mean(plain, found),
            (before_error, after_error), chosen is not None,
        )  # fmt: skip
        try:
            self._look_ahead(out, label, reference, seed, same)
        except SSMError as error:
            out.notes.append(f"held-out rows could not be simulated: {error.found}")

    def _look_ahead(
        self, out: HeldOutGain, label: str, reference: tuple[Fitter, Fit],
        seed: np.random.SeedSequence, same: bool,
    ) -> None:  # fmt: skip
        """Errors of simulations by horizon, and what the reference takes off them beyond what was
        chosen, into `out`. same : the reference is the chosen model.

        Raises
        ------
        SSMError : a filter fails at one of the fits.
        """
        experiments, counts = self.split.experiments, self.split.held_out
        which = horizons(experiments, counts, self.horizon)
        with_curves = reference
        if self.simulation is not None:
            with_curves = fit_for_simulation(*reference, self.split.train, self.simulation).model
        after = self.chosen.simulator if self.chosen else with_curves
        ahead = compared(self.simulator, after, experiments, counts, which, seed)
        number = int(sum(c.sum() for c in counts))
        out.rows += table_rows(label, which, ahead, number)
        if self.chosen is not None and not same:
            beyond = compared(after, with_curves, experiments, counts, which[-1:], seed)
            out.simulated_beyond = _left(out.rows, table_rows(label, which[-1:], beyond, number))


def _left(
    rows: Sequence[Mapping[str, Any]], beyond: Sequence[Mapping[str, Any]]
) -> tuple[float, float] | None:
    """As of `HeldOutGain.simulated_beyond`. rows : those of what was chosen, the windows last;
    beyond : the reference against it."""
    if not beyond or rows[-1]["horizon"] != beyond[-1]["horizon"]:
        return None
    chosen = 1.0 - rows[-1]["share"]  # of the error of the model as it was
    reference = chosen * (1.0 - beyond[-1]["share"])
    left = (chosen - reference) / (1.0 - reference) if reference < 1.0 else 0.0
    return left, beyond[-1]["low"]
