"""What the pages of the gallery share: the look of the plots, and where an example's files are."""

import sys
from pathlib import Path

import matplotlib.pyplot as plt

BLUE, RED, GREEN, PURPLE = "#2a6f97", "#e07a5f", "#6a994e", "#8e6c8a"

plt.rcParams.update({
    "figure.dpi": 110,
    "figure.constrained_layout.use": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": plt.cycler(color=[BLUE, RED, GREEN, PURPLE]),
    "legend.frameon": False,
    "font.size": 9,
})  # fmt: skip


def example(name):
    """The folder of an example, on the path for `from model import ...`."""
    folder = Path(__file__).resolve().parents[2] / "examples" / name
    sys.path.insert(0, str(folder))
    return folder
