"""The gallery at a glance: each example's data, what it is about, and a link to its page."""

from html import escape
from pathlib import Path

import numpy as np
import pandas as pd
from IPython.display import HTML

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
WIDE, HIGH, EDGE = 240.0, 70.0, 5.0  # of a drawing

# Page, data (file and column), title, what it shows.
CARDS = [
    ("lgss", "data.csv", "y", "A linear Gaussian model",
     "one unknown precision, its posterior against quadrature"),
    ("nile", "data.csv", "y", "The Nile: a local level with an intervention",
     "a step of unknown size, and its Bayes factor"),
    ("heating", "data.csv", "y", "A heated room with missing readings", "a known input"),
    ("vehicle", "lane_change.csv", "gyro", "A vehicle in three experiments (single-track model)",
     "four states, two channels, parameters shared by experiments"),
    ("us_growth", "data.csv", "growth", "Regime switching in US growth (Hamilton)",
     "a hidden state of two values, integrated out exactly"),
    ("coal_mines", "data.csv", "y", "Disasters in coal mines",
     "Poisson counts, the log rate a random walk"),
    ("stochastic_volatility", "data.csv", "y", "Stochastic volatility with leverage",
     "the variance depends on past returns; a check by PIT values"),
    ("ricker", "data.csv", "y", "Chaotic population dynamics (Ricker map)",
     "counts of zero, and a comparison of proposals"),
    ("seir", "data.csv", "reported", "An epidemic with reporting (SEIR)",
     "states that are whole numbers, every transition binomial"),
    ("pendulum", "data.csv", "angle", "A pendulum with a motor and an encoder",
     "a rounded encoder, and a speed that is not measured"),
    ("bearings", "data.csv", "bearing", "Tracking a ship by bearings",
     "bearings only, observability by a turn of the observer"),
    ("fan", "data.csv", "y", "A fan with unmodelled drag",
     "prediction errors of a model that lacks an effect"),
]  # fmt: skip


def gallery() -> HTML:
    """All cards, as many side by side as there is room for."""
    return HTML(f'<div class="gallery">{"".join(_card(*card) for card in CARDS)}</div>')


def _card(page: str, file: str, column: str, title: str, about: str) -> str:
    values = pd.read_csv(EXAMPLES / page / file)[column].to_numpy(dtype=float)
    return (
        f'<a href="{page}.html"><svg viewBox="0 0 {WIDE:g} {HIGH:g}" role="img" '
        f'aria-label="the data: {escape(column)}">{_drawn(values)}</svg>'
        f"<strong>{escape(title)}</strong><span>{escape(about)}</span></a>"
    )


def _drawn(values: np.ndarray) -> str:
    """The series as lines that stop at missing values; single ones between them as dots."""
    low, high = np.nanmin(values), np.nanmax(values)
    x = EDGE + (WIDE - 2 * EDGE) * np.arange(len(values)) / (len(values) - 1)
    y = HIGH - EDGE - (HIGH - 2 * EDGE) * (values - low) / (high - low)
    rows = np.flatnonzero(np.isfinite(values))
    parts = []
    for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
        points = " ".join(f"{x[i]:.1f},{y[i]:.1f}" for i in run)
        dot = f'<circle cx="{x[run[0]]:.1f}" cy="{y[run[0]]:.1f}" r="1.2"/>'
        parts.append(dot if len(run) == 1 else f'<polyline points="{points}"/>')
    return "".join(parts)
