"""What a diagnosis found: tables under fixed columns, and what else the renderings read.

Text, page, plots and folder take a `Findings`; `GapReport` is one that can render itself.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

from ssmppl.diagnosis.experiment.design import Separation
from ssmppl.diagnosis.run.failures import Failures
from ssmppl.diagnosis.verdict.verdicts import VERDICTS
from ssmppl.errors import ArgumentError, listing
from ssmppl.language.model.model import Model

if TYPE_CHECKING:
    import pandas as pd

MODES = ("full", "fast")

# The columns of each table. Times are the labels of the data's rows.
COLUMNS: dict[str, tuple[str, ...]] = {
    "where": ("equation", "moment", "t_from", "t_to", "region", "z", "p", "experiment"),
    "causes": (
        "effect", "form", "equation", "kind", "z", "p", "gain_screen", "gain_refit", "class_id",
        "sign", "estimate", "se", "rate",
    ),
    "classes": ("class_id", "effect", "equation", "rho", "separating_input"),
    "probabilities": (
        "effect", "form", "equation", "named", "named_form", "named_equation", "probability",
        "behind", "cut",
    ),
    "signals": ("signal", "input", "nats", "note"),
    "closed": (
        "effect", "horizon", "rmse_before", "rmse_after", "share", "low", "high",
        "nats_per_sample", "F", "F_low", "F_high", "gain_mean", "gain_noise",
    ),
    "missing": ("equation", "variable", "value", "estimate", "low", "high"),
    "formula": ("equation", "term", "coefficient", "se", "share"),
    "detection": ("channel", "statistic", "value", "z", "p"),
    "residual_map": ("equation", "t_from", "t_to", "z", "experiment"),
    "free_run": (
        "experiment", "t", "channel", "observed", "before", "before_low", "before_high", "after",
        "after_low", "after_high",
    ),
    "not_applicable": ("part", "equation", "reason"),
    "left_out": ("part", "reason"),
}  # fmt: skip


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
class Findings:
    """What a diagnosis found, field by field as `GapReport` documents them: what the renderings
    read."""

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
    formula: pd.DataFrame | None = None
    probabilities: pd.DataFrame | None = None
    signals: pd.DataFrame | None = None
    experiment: pd.DataFrame | None = None
    separation: Separation | None = None
    model: Model | None = None
    model_text: str = ""
    chosen: list[str] = field(default_factory=list)
    leading: list[dict[str, Any]] = field(default_factory=list)
    attributes: dict[str, str] = field(default_factory=dict)
    estimates: dict[str, dict[str, tuple[Any, Any]]] = field(default_factory=dict)
    parts: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    settings: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    mode: str = "full"
    interrupted: bool = False
    failures: Failures = field(default_factory=Failures)

    def __post_init__(self) -> None:
        for name, value, known in (("verdict", self.verdict, VERDICTS), ("mode", self.mode, MODES)):
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
            `where`, `causes`, `classes`, `closed` and the others above, and `left_out`; `missing`,
            `formula`, `probabilities` and `signals` only if there is one.
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
