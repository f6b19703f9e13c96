"""One case: a verb of the public interface called on a random model, with what it gave judged."""

from __future__ import annotations

import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

import ssmppl as ssm
from tests.fuzz.data import random_data, random_parameters
from tests.fuzz.models import Recipe

FEW: dict[str, Any] = {"draws": 3, "warmup": 3, "chains": 1, "progress": False}
PROPOSALS = (
    "auto", "bootstrap", "guided", "auxiliary", "twisted", "marginal", "tempered",
    "kalman", "forward",
)  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """verb : what was called. kind : "result", the class of our error, or what went wrong, in
    capitals. detail : the message, or the traceback of what is no error of ours."""

    verb: str
    kind: str
    detail: str = ""

    @property
    def failed(self) -> bool:
        return self.kind.isupper()


class Wrong(AssertionError):
    """A result that cannot be one."""


class LeftOut(Exception):
    """Nothing can be said of this case."""


def judged(verb: str, run: Callable[[], Any], file: str = "") -> Outcome:
    """What came of a call. file : the model's, which its errors have to name."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)  # NumPy's, of our own arithmetic
            run()
    except ssm.ModelError as error:
        named = not file or file in str(error)
        return Outcome(verb, "ModelError" if named else "ERROR WITHOUT A PLACE", str(error))
    except ssm.SSMError as error:
        kind = type(error).__name__
        return Outcome(
            verb, kind if error.fix or error.where else "ERROR WITHOUT A FIX", str(error)
        )
    except Wrong as error:
        return Outcome(verb, "WRONG RESULT", str(error))
    except LeftOut as reason:
        return Outcome(verb, "left out", str(reason))
    except RuntimeWarning:
        return Outcome(verb, "WARNING OF NUMPY'S", traceback.format_exc())
    except Exception:
        return Outcome(verb, "ERROR NOT OURS", traceback.format_exc())
    return Outcome(verb, "result")


@dataclass
class Case:
    """Random arguments for one model; `odd` is the probability of something unusual in each."""

    rng: np.random.Generator
    model: ssm.Model
    recipe: Recipe
    odd: float = 0.15

    def data(self) -> Any:
        return random_data(self.rng, self.recipe, self.odd)[0]

    def parameters(self) -> Any:
        return random_parameters(self.rng, self.recipe, self.odd)

    def settings(self) -> dict[str, Any]:
        """Arguments of a filter."""
        rng = self.rng
        out: dict[str, Any] = {
            "particles": int(rng.choice([2, 5, 10, 40])),
            "seed": int(rng.integers(99)),
        }
        if rng.random() < 0.3:
            out["proposal"] = str(rng.choice(PROPOSALS))
        if rng.random() < 0.3:
            out["ess_threshold"] = float(rng.choice([0.0, 0.3, 0.5, 1.0]))
        if rng.random() < 0.3:
            out["resampling"] = str(rng.choice(["multinomial", "stratified", "residual"]))
        if rng.random() < 0.3 * self.odd:
            odd = {
                "particles": (0, -1, 1, 1.5, "10", None, True, np.nan),
                "seed": (-1, 0.5, "a", True),
                "proposal": ("gided", None, 3, ""), "ess_threshold": (-1, 2, np.nan, "0.5", None),
                "resampling": ("sistematic", None, 1), "repeats": (0, -1, 2.5, None),
            }  # fmt: skip
            name = str(rng.choice(list(odd)))
            out[name] = odd[name][rng.integers(len(odd[name]))]
        return out

    # -- verbs
    def log_likelihood(self) -> None:
        given = {"repeats": int(self.rng.choice([1, 3])), **self.settings()}
        found = ssm.log_likelihood(self.model, self.data(), self.parameters(), **given)
        _check(found.shape == (given["repeats"],), f"shape {found.shape}")
        _check(not np.isnan(found).any() and not (found == np.inf).any(), f"log-likelihood {found}")

    def particle_filter(self) -> None:
        given = self.settings()
        found = ssm.particle_filter(self.model, self.data(), self.parameters(), **given)
        for one in found if isinstance(found, list) else [found]:
            ess = one["ess"].values
            most = given.get("particles", 1000) * (1 + 1e-9)
            if given.get("proposal") in (None, "auto", "kalman", "forward"):
                most = np.inf  # an exact filter has no particles
            _check(bool(np.all((ess >= 1 - 1e-9) & (ess <= most))), f"effective sizes {ess}")
            for name in self.recipe.channels:
                pit = one[f"{name}_pit"].values if f"{name}_pit" in one else np.zeros(0)
                pit = pit[~np.isnan(pit)]
                _check(bool(np.all((pit >= 0) & (pit <= 1))), f"PIT values {pit}")

    def kalman_filter(self) -> None:
        _finite(ssm.kalman_filter(self.model, self.data(), self.parameters()), "covariance")

    def forward_filter(self) -> None:
        ssm.forward_filter(self.model, self.data(), self.parameters(), seed=1)

    def simulate(self) -> None:
        steps = int(self.rng.choice([1, 5, 12]))
        inputs = {
            n: self.rng.normal(size=(steps, length) if length > 1 else steps)
            for n, length in self.recipe.inputs.items()
        }
        given: dict[str, Any] = {"steps": steps, "inputs": inputs or None}
        if self.rng.random() < self.odd:
            given["steps"] = (0, -3, 2.5, None, "5", 1)[self.rng.integers(6)]
        seed = int(self.rng.integers(50))
        at = self.parameters()
        one, two = (ssm.simulate(self.model, at, seed=seed, **given) for _ in range(2))
        _check(one.equals(two), "another simulation by the same seed")

    def smooth(self) -> None:
        method = self.rng.choice(
            np.array([None, "ffbsi", "fixed_lag", "kalman", "pgas"], dtype=object)
        )
        ssm.smooth(
            self.model, self.data(), self.parameters(), method, particles=10, trajectories=5, seed=1
        )  # fmt: skip

    def score(self) -> None:
        ssm.score(
            self.model, self.data(), self.parameters(),
            particles=10, trajectories=5, repeats=2, seed=1,
        )  # fmt: skip

    def explain(self) -> None:
        text = str(ssm.explain(self.model, self.data() if self.rng.random() < 0.5 else None))
        _check("nan" not in text.split(), "nan in an explanation")

    def sample(self) -> None:
        methods = (
            None, None, ssm.PMMH(particles=10), ssm.PGAS(particles=5), ssm.Gibbs(),
            ssm.MetropolisHastings(),
        )  # fmt: skip
        start = self.parameters() if self.rng.random() < 0.5 else None
        method = methods[self.rng.integers(len(methods))]
        ssm.sample(self.model, self.data(), method, start=start, seed=1, **FEW)

    def predict(self) -> None:
        steps = (1, 5, 12, 0, None)[self.rng.integers(5)]
        ssm.predict(self.model, data=self.data(), steps=steps, draws=3, seed=1)

    def maximize(self) -> None:
        method = (None, ssm.IF2(particles=10, iterations=2))[self.rng.integers(2)]
        start = self.parameters() if self.rng.random() < 0.7 else None
        ssm.maximize(self.model, self.data(), method, start=start, seed=1, progress=False)


def _check(holds: bool, found: str) -> None:
    if not holds:
        raise Wrong(found)


def _finite(found: Any, name: str) -> None:
    for one in found if isinstance(found, list) else [found]:
        _check(bool(np.isfinite(one[name].values).all()), f"{name} holds what is no number")


WEIGHTS: dict[str, float] = {
    "log_likelihood": 45, "particle_filter": 12, "simulate": 14, "kalman_filter": 6, "smooth": 5,
    "forward_filter": 3, "score": 3, "explain": 4, "sample": 4, "predict": 3, "maximize": 1,
}  # fmt: skip


def random_call(case: Case, weights: dict[str, float]) -> tuple[str, Callable[[], Any]]:
    """A verb, and the call."""
    shares = np.array(list(weights.values()), dtype=float)
    verb = str(case.rng.choice(list(weights), p=shares / shares.sum()))
    return verb, getattr(case, verb)
