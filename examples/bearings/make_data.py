"""Writes data.csv: a target and an observer for 60 minutes; the fog swallowed six bearings."""

from pathlib import Path

import numpy as np
import pandas as pd

STEPS, SEED = 60, 12
START = np.array([4.0, 14.0, 0.25, -0.12])
Q, R = 5e-4, 0.01**2


def path(rng):
    """Positions and velocities (T, 4): the model's transition, a step a minute."""
    eye = np.eye(2)
    move = np.block([[eye, eye], [0 * eye, eye]])
    root = np.linalg.cholesky(Q * np.block([[eye / 3, eye / 2], [eye / 2, eye]]))
    x = [START]
    for _ in range(STEPS - 1):
        x.append(move @ x[-1] + root @ rng.standard_normal(4))
    return np.array(x)


if __name__ == "__main__":
    rng = np.random.default_rng(SEED)
    x = path(rng)
    course = np.repeat([1.2, -0.9, 1.5, 0.3], STEPS // 4)  # of the observer, radians from north
    steps = 0.3 * np.column_stack([np.sin(course), np.cos(course)])
    own = np.vstack([np.zeros(2), np.cumsum(steps, axis=0)[:-1]]).round(4)
    bearing = np.arctan2(x[:, 0] - own[:, 0], x[:, 1] - own[:, 1])
    bearing = (bearing + np.sqrt(R) * rng.standard_normal(STEPS)).round(5)
    bearing[[7, 22, 23, 24, 41, 52]] = np.nan
    table = pd.DataFrame({"time": np.arange(STEPS), "east": own[:, 0], "north": own[:, 1]})
    table["bearing"] = bearing
    table["true_east"], table["true_north"] = x[:, 0].round(3), x[:, 1].round(3)
    table.to_csv(Path(__file__).with_name("data.csv"), index=False)
