"""Seeds of the parts of a diagnosis, so that each has its own numbers whatever else is run.

The places below a seed are numbered here. Another number gives other draws: they stay as they are.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Stage(IntEnum):
    """Below the seed of the diagnosis: a stage."""

    FIT = 1
    SCREEN = 2
    SELECTION = 4
    EXPERIMENT = 7  # that separates a class
    HELD_OUT = 8
    STATES = 11  # at the fit, for the scales
    TIMING = 12
    RECOVERY = 13  # of the leading effects from data simulated with each
    CURVES = 14  # by themselves


class Choice(IntEnum):
    """Below the seed of a selection: a step of it."""

    SINGLES = 1
    PAIRS = 2
    FURTHER = 3  # effects, below which are the screens by number of effects
    REFIT_TEST = 4
    STANDARD_ERRORS = 5
    BASE = 6  # fitted from the best refit
    SHAPES = 7
    CHOSEN_SHAPES = 8
    SIMULATION = 9  # predictions further ahead of the model as it is
    EXPLAINED = 10  # whether a cause explains what gained more
    BACKWARD = 12  # without an effect that came before others
    OVERLOOKED = 11  # mechanisms that a screen at a strength of zero does not see
    SEARCHED = 14  # what a search found in a larger record
    SEARCHED_SHAPES = 15
    TESTED = 16  # what gained most in the test of a refit
    OTHER_END = 13  # lags and delays of inputs for those of a sensor, and the other way round


class Task(IntEnum):
    """Below the seed of a list of tasks, with a number each."""

    REFIT = 5
    FURTHER_REFITS = 10  # and the number of effects so far is added
    BLOCK = 20  # left out
    TEST_FIT = 100  # of simulated data, in the test of a refit
    TEST_SCORES = 200


class Stream(IntEnum):
    """Below the seed of a fit, or of its predictions: random numbers of one use."""

    ASCENT = 1
    LIKELIHOOD = 2
    INFORMATION = 3
    START = 4  # of a refit
    PREDICTIONS = 6
    FREE_RUN = 7
    TOP = 8  # of the extended filter, checked by particles
    WAVES = 9  # refined in period and phase
    AHEAD = 10  # simulations from filtered states


def child_seed(seed: np.random.SeedSequence, *path: int) -> np.random.SeedSequence:
    """The seed at a place below `seed`: a stage, a block, a refit."""
    return np.random.SeedSequence(seed.entropy, spawn_key=(*seed.spawn_key, *map(int, path)))
