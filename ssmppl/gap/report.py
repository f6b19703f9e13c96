"""GapReport: what `diagnose` returns. Tables under fixed names, and the three answers in words.

The report holds results only. Its words are made in `words.py`; what draws it and writes it to a
folder stands above this module, in `ssmppl.plots`, and enters itself into `PRESENTERS`.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ssmppl.errors import ArgumentError, listing
from ssmppl.gap.failures import Failures
from ssmppl.gap.printed import report_html, report_text
from ssmppl.language.model import Model

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["COLUMNS", "MODES", "PRESENTERS", "VERDICTS", "GapReport", "tabulate"]

VERDICTS = ("effect", "none of these", "no measurable gap")
MODES = ("full", "fast")

# The columns of each table. Times are the labels of the data's rows.
COLUMNS: dict[str, tuple[str, ...]] = {
    "where": ("equation", "moment", "t_from", "t_to", "region", "z", "p", "experiment"),
    "causes": (
        "effect", "form", "equation", "z", "p", "gain_screen", "gain_refit", "class_id", "sign",
        "estimate", "se",
    ),
    "classes": ("class_id", "effect", "equation", "rho", "separating_input"),
    "closed": (
        "effect", "F", "F_low", "F_high", "nats_per_sample", "gain_mean", "gain_noise",
        "rmse_before", "rmse_after",
    ),
    "missing": ("equation", "variable", "value", "estimate", "low", "high"),
    "detection": ("channel", "statistic", "value", "z", "p"),
    "residual_map": ("equation", "t_from", "t_to", "z", "experiment"),
    "free_run": (
        "experiment", "t", "channel", "observed", "before", "before_low", "before_high", "after",
        "after_low", "after_high",
    ),
    "not_applicable": ("part", "equation", "reason"),
    "left_out": ("part", "reason"),
}  # fmt: skip

# Entered by `ssmppl.plots`: "plot" (report) -> Figure, "save" (report, folder) -> Path.
PRESENTERS: dict[str, Callable[..., Any]] = {}


def tabulate(table: str, rows: Iterable[Mapping[str, Any]] = ()) -> pd.DataFrame:
    """`rows` as one of the tables of `COLUMNS`; what a row does not give is missing (NaN).

    Raises
    ------
    ArgumentError : a row has a column that the table does not have.
    """
    import pandas as pd

    rows = list(rows)
    columns = COLUMNS[table]
    for row in rows:
        for name in row:
            if name not in columns:
                raise ArgumentError(
                    f"the table {table!r} of a report has no column {name!r}",
                    fix=f"its columns are: {listing(str(name), columns)}",
                )
    return pd.DataFrame(rows, columns=list(columns))


@dataclass(frozen=True, eq=False)
class GapReport:
    """Where a model differs from its data, which effect is missing, and how far the gap closes.

    `print` it for the answers in words; `plot()` draws them; `save(folder)` writes everything.

    Parameters
    ----------
    verdict : "effect", "none of these" or "no measurable gap".
    where : one row for each place that stands out, strongest first: the equation, the moment of
        its law (mean, scale, tails, time dependence), when (t_from, t_to), the region of states and
        inputs in words, z and its family-wise p.
    causes : candidate effects, best first. `gain_screen` is the gain in nats that the score
        predicts, `gain_refit` the one after refitting, NaN where it was not refitted; `sign` the
        constraint on the strength or the sign found, `estimate` and `se` that strength.
        Effects that these data cannot tell apart share a `class_id`.
    classes : the members of each class, their correlation `rho` with the best one, and in words
        the input that would separate them best ("" if none would).
    closed : the chosen model first: share F of the closable gap that it closes on data that took
        no part in choosing it, with a 95% interval (infinite ends where the data do not bound it;
        F NaN where there is no measurable gap); the gain in nats per sample, and its parts in all
        from the mean and from the noise law; the error of a free run before and after.
    detection : tests of the one-step predictions by observation channel.
    residual_map : standardised smoothed score by equation and window of time.
    free_run : the data, and the models run without seeing them, before and after (NaN if there is
        no after), with 95% bands.
    not_applicable : parts that do not apply to this model, the equation ("" if all), and why.
    missing : estimated curve of what is missing over a state, input or time, with a 95% band.
    model, model_text : the model with the chosen effects added, and its file; None and "" if
        nothing was chosen.
    chosen : labels of the chosen effects: the effect's name, or "<effect> on <equation>" where
        that effect was tried on several equations.
    leading : for each effect that the verdict names, its `row` in `causes`, and form, sign,
        estimate and se in the model with all of them; or `row` and `unfitted` for one that the
        screen found and that could not be fitted.
    estimates : {"before": {parameter: (value, standard error)}, "after": ...}; error 0 if fixed.
    parts : {"screen": (first, last), "confirm": ...}, row labels of the rows that were used, or
        {"cross-fitting": number of blocks}; any further entry is text, such as "choice".
    notes : what has to be known before the figures are used.
    settings : the arguments used; of these the words use `alpha`, `candidates` (number tried),
        `model` (name), `samples`, `seed`, `experiment` (whose rows `parts` tells, of several).
    seconds, mode, interrupted : run time; "full" or "fast" (which stops after the screen); whether
        it was interrupted, and only the stages done before are here.
    failures : the parts that an error ended, while the rest went on: see `left_out`.
    """

    verdict: str
    where: pd.DataFrame
    causes: pd.DataFrame
    classes: pd.DataFrame
    closed: pd.DataFrame
    detection: pd.DataFrame
    residual_map: pd.DataFrame
    free_run: pd.DataFrame
    not_applicable: pd.DataFrame
    missing: pd.DataFrame | None = None
    model: Model | None = None
    model_text: str = ""
    chosen: list[str] = field(default_factory=list)
    leading: list[dict[str, Any]] = field(default_factory=list)
    estimates: dict[str, dict[str, tuple[Any, Any]]] = field(default_factory=dict)
    parts: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    settings: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    mode: str = "full"
    interrupted: bool = False
    failures: Failures = field(default_factory=Failures)

    def __post_init__(self) -> None:
        for name, value, known in (
            ("verdict", self.verdict, VERDICTS),
            ("mode", self.mode, MODES),
        ):
            if value not in known:
                raise ArgumentError(
                    f"the {name} of a report cannot be {value!r}",
                    fix=f"it is one of: {listing(str(value), known)}",
                )
        for name, table in self.tables().items():
            lacking = [c for c in COLUMNS[name] if c not in table.columns]
            if lacking:
                raise ArgumentError(
                    f"the table {name!r} of a report lacks {', '.join(lacking)}",
                    fix=f"its columns are: {', '.join(COLUMNS[name])}",
                )

    def tables(self) -> dict[str, pd.DataFrame]:
        """Every table by name.

        Returns
        -------
        dict of DataFrames
            `where`, `causes`, `classes`, `closed` and the others above, and `left_out`; `missing`
            only if there is one.
        """
        names = [f.name for f in fields(self) if f.name in COLUMNS]
        found = {name: getattr(self, name) for name in [*names, "left_out"]}
        return {name: table for name, table in found.items() if table is not None}

    @property
    def left_out(self) -> pd.DataFrame:
        """What an error ended: the part (a candidate, a refit, a block, a table, a panel) and the
        reason in one line; no rows where the answer is complete."""
        return tabulate("left_out", [{"part": p, "reason": r} for p, r in self.failures])

    @property
    def title(self) -> str:
        """The model's name; "" if it is not known."""
        return str(self.settings.get("model") or (self.model.name if self.model else ""))

    def __str__(self) -> str:
        return report_text(self)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return report_html(self)

    def plot(self) -> Any:
        """Draw the residual map, the ranked effects, the missing term and the free run.

        Returns
        -------
        Figure : of Matplotlib.
        """
        return _presenter("plot")(self)

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write the tables (CSV), the plots (PNG), the model file and the page to a folder.

        Parameters
        ----------
        folder : made where there is none.

        Returns
        -------
        Path : of the page, `index.html`.
        """
        page: Path = _presenter("save")(self, Path(folder))
        return page


def _presenter(what: str) -> Callable[..., Any]:
    if what not in PRESENTERS:
        raise ArgumentError(
            f"nothing is loaded that can {what} a report", fix="import ssmppl, or ssmppl.plots"
        )
    return PRESENTERS[what]
