"""Levels and trends (Harvey 1989, "Forecasting, structural time series models and the Kalman
filter", sections 2.3 and 4.1; Durbin and Koopman 2012, "Time series analysis by state space
methods", section 3.2)."""

from __future__ import annotations

from typing import Any

from ssmppl.arguments import checked
from ssmppl.structural.component import Component, Writer, noise

UNIT = "ssm.Uniform(0, 1)"


@checked
def level(model: Any, *, sd: Any = None, initial: Any = None, name: str = "level") -> Component:
    """A level that moves as a random walk (Harvey 1989, section 2.3.1).

        level_t = level_{t-1} + N(0, sd^2)

    Parameters
    ----------
    model : it is written into this.
    sd : standard deviation of its step, in the units of the data: a distribution as its prior, a
        number where it is known (0: the level never moves), or the name of a parameter that a
        @prior of yours declares. By default the parameter `<name>_sd` with a flat prior,
        `ssm.HalfFlat()`: of no proper prior is it known on which scale the data are, and under a
        flat one the posterior's mode is the maximum likelihood estimate. A flat prior cannot be
        drawn from, and leaves the evidence undefined; give a proper one, such as
        `ssm.HalfNormal(sd=...)` of the data's scale, for these, and for short series.
    initial : distribution of the level at the first row, or a number where it is known; by default
        flat, which is an exact diffuse start: statsmodels' `use_exact_diffuse=True`, whose log
        likelihood is less by log(2 pi) / 2 for each such state.
    name : of the component and of its state.

    Returns
    -------
    Component : to be handed to `observe` and `plot_components`.

    Raises
    ------
    ArgumentError : an argument is of the wrong kind, or the model has a component of this name.
    """
    w = Writer(model, "level", name)
    step = w.sd(f"{name}_sd", "sd", sd)
    w.state(name, w.start("initial", initial), noise(name, step))
    return w.add(name, parameters=[step.reads] if step.reads else [])


@checked
def trend(
    model: Any, *, level_sd: Any = None, slope_sd: Any = None, damping: Any = None,
    initial: Any = None, initial_slope: Any = None, name: str | None = None,
) -> Component:  # fmt: skip
    """A level with a slope that moves: the local linear trend (Harvey 1989, section 2.3.2).

        level_t = level_{t-1} + slope_{t-1} + N(0, level_sd^2)
        slope_t = damping slope_{t-1} + N(0, slope_sd^2)

    Parameters
    ----------
    model : it is written into this.
    level_sd, slope_sd : standard deviations of the steps, as `sd` of `level`. `level_sd=0` is the
        smooth trend (an integrated random walk), `slope_sd=0` a random walk with drift.
    damping : the share of the slope that is left after a row. By default 1. True: a parameter,
        uniform on (0, 1) (the damped trend of Gardner and McKenzie 1985, Management Science 31);
        or a distribution as its prior, a number, or the name of a parameter.
    initial, initial_slope : distributions at the first row, as `initial` of `level`.
    name : of the component. Its states are `level` and `slope`, its parameters `level_sd`,
        `slope_sd` and `damping`; of a name that is given it is `<name>_level` and so on.

    Returns
    -------
    Component : to be handed to `observe` and `plot_components`.

    Raises
    ------
    ArgumentError : an argument is of the wrong kind, or the model has a component of this name.
    """
    w = Writer(model, "trend", "trend" if name is None else name)
    own = "" if name is None else f"{name}_"
    level_, slope = f"{own}level", f"{own}slope"
    level_step = w.sd(f"{own}level_sd", "level_sd", level_sd)
    slope_step = w.sd(f"{own}slope_sd", "slope_sd", slope_sd)
    kept, used = slope, [level_step, slope_step]
    if damping is not None and damping is not False:
        given = None if damping is True else damping
        share = w.quantity(f"{own}damping", "damping", given, UNIT)
        kept = f"{share.text} * {slope}"
        used.append(share)
    w.state(level_, w.start("initial", initial), noise(f"{level_} + {slope}", level_step))
    w.state(slope, w.start("initial_slope", initial_slope), noise(kept, slope_step))
    return w.add(level_, parameters=[q.reads for q in used if q.reads])
