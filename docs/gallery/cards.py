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
    ("lgss", "data.csv", "y", "A linear Gaussian series",
     "one unknown precision, its posterior against quadrature"),
    ("nile", "data.csv", "y", "The Nile and a dam",
     "a level that drifts, a step of unknown size, a Bayes factor"),
    ("heating", "data.csv", "y", "A heated room", "an input, and readings that are missing"),
    ("vehicle", "lane_change.csv", "gyro", "A vehicle, driven in three experiments",
     "four states, two channels, parameters shared by experiments"),
    ("us_growth", "data.csv", "growth", "Growth that switches",
     "a hidden state of two values, integrated out exactly"),
    ("coal_mines", "data.csv", "y", "Disasters in coal mines", "counts whose rate drifts"),
    ("stochastic_volatility", "data.csv", "y", "Stochastic volatility with leverage",
     "returns that push their own variance; residuals that tell whether it fits"),
    ("ricker", "data.csv", "y", "A population that overshoots (Ricker)",
     "near chaos, counts of zero, and why the proposal matters"),
    ("seir", "data.csv", "reported", "An epidemic with reporting (SEIR)",
     "states that are whole numbers, every transition binomial"),
    ("pendulum", "data.csv", "angle", "A pendulum with a motor and an encoder",
     "an encoder's steps, and a speed that nothing measures"),
    ("bearings", "data.csv", "bearing", "Tracking a ship by bearings",
     "an angle alone, until the observer turns"),
    ("fan", "data.csv", "y", "A fan that lacks something",
     "a model that misses an effect, and how one notices"),
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
