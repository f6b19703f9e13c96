"""What a question is, who answers it, and what an answer holds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

OWN = "ssmppl"


class Unavailable(Exception):
    """Why a program cannot answer on this machine."""


@dataclass(frozen=True)
class Answer:
    """What one run of a program said.

    Parameters
    ----------
    estimates : parameter -> (estimate, standard error), or (posterior mean, standard deviation).
    remarks : further figures and words by name, such as the log-likelihood or R-hat.
    amount : of a question that asks for a rate, how much was made.
    seconds, processor : on the clock and of the processor, where the program itself measured
        them; None: those of the whole run.
    """

    estimates: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    remarks: Mapping[str, float | str] = field(default_factory=dict)
    amount: float | None = None
    seconds: float | None = None
    processor: float | None = None

    def __str__(self) -> str:
        found = [f"{name} {value:.5g} ({sd:.2g})" for name, (value, sd) in self.estimates.items()]
        for name, said in self.remarks.items():
            shown = said if isinstance(said, str) else f"{said:.{2 if abs(said) >= 10 else 4}f}"
            found.append(f"{name} {shown}")
        return ", ".join(found)


Run = Callable[[int], Answer]  # of a seed


@dataclass(frozen=True)
class Program:
    """name : as it is printed. prepare : makes a run, or raises `Unavailable` or `ImportError`.
    packages : whose versions are reported.
    """

    name: str
    prepare: Callable[[], Run]
    packages: tuple[str, ...] = ()


@dataclass(frozen=True)
class Question:
    """One row of the table.

    Parameters
    ----------
    key : by which the command line names it.
    text : what is asked, of which model and data.
    goal : seconds in which ssmppl shall answer; of a rate, how much it shall make a second.
    programs : ssmppl first, then what a user would take instead.
    faults : from ssmppl's answer and the others' by name, what is wrong with the former.
    rate : the unit of what is made in a second; "" where seconds are asked for.
    """

    key: str
    text: str
    goal: float
    programs: Sequence[Program]
    faults: Callable[[Answer, Mapping[str, Answer]], list[str]]
    rate: str = ""


def estimated(found: Any) -> Answer:
    """The answer of `ssm.maximize`."""
    rows = found.table()
    estimates = {
        str(label): (row["estimate"], row["standard_error"]) for label, row in rows.iterrows()
    }
    remarks: dict[str, float | str] = {"log-likelihood": float(found.log_likelihood)}
    if "monte_carlo_error" in rows:
        share = (rows["monte_carlo_error"] / rows["standard_error"]).max()
        remarks["largest Monte Carlo error in standard errors"] = float(share)
    remarks["by"] = found.attrs["method"]
    if found.attrs.get("converged") is False:
        remarks["note"] = "not converged"
    return Answer(estimates, remarks)


def posterior(
    draws: Mapping[str, np.ndarray], shown: Sequence[str] | None = None, by: str = ""
) -> Answer:
    """The answer of a sampler.

    Parameters
    ----------
    draws : parameter -> draws (chain, draw, ...).
    shown : the parameters whose mean and standard deviation are told; None: all. R-hat and the
        bulk ESS (Vehtari et al. 2021) are the worst of all.
    by : the method.
    """
    import arviz as az

    components: dict[str, np.ndarray] = {}
    for name, values in draws.items():
        for index in np.ndindex(values.shape[2:]):
            label = name + (f"[{', '.join(map(str, index))}]" if index else "")
            components[label] = values[(slice(None), slice(None), *index)]
    estimates = {
        label: (float(v.mean()), float(v.std())) for label, v in components.items()
        if shown is None or label.split("[")[0] in shown
    }  # fmt: skip
    remarks: dict[str, float | str] = {
        "R-hat": max(float(az.rhat(v)) for v in components.values()),
        "ESS": min(float(az.ess(v)) for v in components.values()),
    }
    return Answer(estimates, remarks | ({"by": by} if by else {}))


def sampled(idata: Any, names: Sequence[str], shown: Sequence[str] | None = None) -> Answer:
    """The answer of `ssm.sample` in the parameters `names`."""
    draws = {name: idata.posterior[name].to_numpy() for name in names}
    return posterior(draws, shown, str(idata.posterior.attrs["method"]))


def distant(
    own: Answer, right: Mapping[str, float], by: float, unit: Mapping[str, float] | None = None
) -> list[str]:
    """Estimates that are further than `by` standard errors (`unit`; None: ssmppl's) from what is
    right."""
    out = []
    for name, value in right.items():
        mean, sd = own.estimates[name]
        away = abs(mean - value) / (sd if unit is None else unit[name])
        if not away <= by:
            out.append(f"{name} is {mean:.5g}, {away:.2g} standard errors from {value:.5g}")
    return out


def below(own: Answer, best: float, by: float) -> list[str]:
    """Says so where the log-likelihood is more than `by` below the best that is known."""
    value = own.remarks["log-likelihood"]
    if isinstance(value, float) and value >= best - by:
        return []
    return [f"the log-likelihood is {value:.6g}, where {best:.6g} can be had"]


def unmixed(own: Answer, rhat: float) -> list[str]:
    """Says so where the worst R-hat is above `rhat`."""
    found = own.remarks["R-hat"]
    return [] if isinstance(found, float) and found <= rhat else [f"R-hat {found:.3f}"]
