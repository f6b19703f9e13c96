"""Made-up reports of every kind, for the tests of what a reader sees: no diagnosis is run."""

# ruff: noqa: C408 -- rows read better as keyword arguments
import dataclasses

import numpy as np
import pandas as pd

from ssmppl.diagnosis.experiment.design import ALIKE, BEHIND, OUTSIDE, Separation, Tried
from ssmppl.diagnosis.experiment.signals import Signal, sine, triangle
from ssmppl.diagnosis.report.findings import tabulate
from ssmppl.diagnosis.report.report import GapReport
from ssmppl.diagnosis.report.tables import signals_table

NAN = float("nan")

MODEL_TEXT = '''"""oscillator, with quadratic drag on v added."""

import numpy as np
import ssmppl as ssm

model = ssm.Model("oscillator, augmented", inputs=("u",))


@model.prior
def prior():
    return {
        "k": ssm.HalfNormal(sd=10),
        "q": ssm.HalfNormal(sd=1),
        "quadratic_drag_v": ssm.HalfFlat(),
    }


@model.initial
def initial():
    return {"x": ssm.Normal(0, sd=1), "v": ssm.Normal(0, sd=1)}


@model.transition
def transition(x, v, u, k, q, quadratic_drag_v):
    drag = -quadratic_drag_v * v * np.abs(v)  # added: quadratic drag on v
    return {"x": ssm.Dirac(x + 0.05 * v), "v": ssm.Normal(v + 0.05 * (u - k * x) + drag, sd=q)}


@model.observation
def observation(x):
    return {"y": ssm.Normal(x, sd=0.05)}
'''


def effect_found():
    """One effect, one rival it cannot be told from, refits, a curve and a free run."""
    kinds = {"outliers": "noise law", "heteroscedastic noise": "noise law"}
    causes = [
        ("quadratic drag", "", "v", 6.2, 0.0004, 19.2, 24.3, 1, ">= 0", 0.3124, 0.0413),
        ("state-dependent damping", "−λ x² v", "v", 5.9, 0.0007, 17.4, 22.9, 1, ">= 0", 0.21, 0.03),
        ("coulomb friction", "v0 = 0.2", "v", 4.1, 0.012, 8.4, 10.1, 2, ">= 0", 0.093, 0.022),
        ("coulomb friction", "v0 = 0.05", "v", 3.8, 0.031, 7.2, NAN, 2, ">= 0", 0.081, 0.021),
        ("input saturation", "at ±1.2", "u", 2.9, 0.09, 4.2, 3.9, 3, ">= 0", 0.12, 0.05),
        ("cubic stiffness", "", "v", -1.8, 0.54, 1.6, NAN, 4, "±", -0.041, 0.023),
        ("sensor bias", "", "y", 0.7, 0.99, 0.2, NAN, 5, "±", 0.0021, 0.0030),
        ("outliers", "", "y", 0.1, 1.0, 0.0, NAN, 6, ">= 0", 0.0004, 0.0100),
        ("heteroscedastic noise", "with |v|", "y", -0.2, 1.0, 0.0, NAN, 7, "±", -0.01, 0.05),
    ]
    names = ("effect", "form", "equation", "z", "p", "gain_screen", "gain_refit", "class_id",
             "sign", "estimate", "se")  # fmt: skip
    separating = "a slow sine of u that keeps x small while v is large"
    classes = [
        (1, "quadratic drag", "v", 1.0, separating),
        (1, "state-dependent damping", "v", 0.96, separating),
        *[(i, e, q, 1.0, "") for i, e, q in ((2, "coulomb friction", "v"),
                                             (3, "input saturation", "u"),
                                             (4, "cubic stiffness", "v"))],
    ]  # fmt: skip
    closed = [
        ("quadratic drag", 0.861, 0.71, 0.99, 0.0812, 21.2, 2.1, 0.213, 0.094),
        ("state-dependent damping", 0.812, 0.64, 0.95, 0.0766, 20.1, 1.8, 0.213, 0.101),
        ("coulomb friction", 0.33, 0.12, 0.52, 0.031, 8.0, 1.1, 0.213, 0.171),
    ]
    fields = ("effect", "F", "F_low", "F_high", "nats_per_sample", "gain_mean", "gain_noise",
              "rmse_before", "rmse_after")  # fmt: skip
    by_horizon = [
        ("1", 0.052, 0.051, 0.02, -0.01, 0.05, 0.08),
        ("10", 0.101, 0.062, 0.386, 0.3, 0.46, 0.31),
        ("1 to 100", 0.208, 0.091, 0.5625, 0.48, 0.63, 0.92),
    ]
    ahead = ("horizon", "rmse_before", "rmse_after", "share", "low", "high", "nats_per_sample")
    t, observed, before, after = oscillation(1000)
    v = np.linspace(-2.4, 2.4, 41)
    band = 0.03 + 0.04 * (v / 2) ** 2
    curve = -0.31 * v * np.abs(v) * 0.9 + 0.05 * np.sin(2 * v)
    return GapReport(
        verdict="effect",
        where=tabulate("where", [
            dict(equation="v", moment="mean", t_from=412, t_to=563, region="where |v| > 1.2",
                 z=6.13, p=0.0004),
            dict(equation="y", moment="scale", t_from=1, t_to=1000, region="", z=2.1, p=0.31),
        ]),
        causes=tabulate("causes", [
            dict(zip(names, row, strict=True), kind=kinds.get(row[0], "mechanism"))
            for row in causes
        ]),
        classes=tabulate("classes", [
            dict(class_id=i, effect=e, equation=q, rho=r, separating_input=s)
            for i, e, q, r, s in classes
        ]),
        closed=tabulate("closed", [
            *(dict(zip(fields, row, strict=True), horizon="free run") for row in closed),
            *(dict(zip(ahead, row, strict=True), effect="quadratic drag") for row in by_horizon),
        ]),
        detection=tabulate("detection", [
            dict(channel="y", statistic=s, value=x, z=z, p=p)
            for s, x, z, p in (("mean", 0.02, 0.4, 0.99), ("variance", 1.06, 1.1, 0.8),
                               ("autocorrelation at lag 1", 0.21, 5.2, 0.0008),
                               ("correlation of the square with u at lag 2", 0.13, 3.4, 0.021))
        ]),
        residual_map=residual_map(["x", "v", "y"], 1000, 20, {"v": (8, 11)}),
        free_run=free_run({"1": (t, {"y": (observed, before, after)})}),
        not_applicable=tabulate("not_applicable", [
            dict(part="score of the transition mean", equation="x", reason="x has no noise of its "
                 "own; its effects are scored through v"),
        ]),
        missing=tabulate("missing", [
            dict(equation="v", variable="v", value=a, estimate=b, low=b - 2 * s, high=b + 2 * s)
            for a, b, s in zip(v, curve, band, strict=True)
        ]),
        model_text=MODEL_TEXT,
        chosen=["quadratic drag"],
        estimates={
            "before": {"k": (8.812, 0.214), "q": (0.0912, 0.0041), "m": (1.2, 0.0)},
            "after": {"k": (9.934, 0.152), "q": (0.0503, 0.0030), "m": (1.2, 0.0),
                      "quadratic_drag_v": (0.3124, 0.0413)},
        },
        parts={"screen": (1, 400), "choose": (411, 700), "confirm": (711, 1000)},
        settings={"model": "oscillator", "alpha": 0.05, "candidates": 87, "samples": 1000,
                  "seed": 1, "bootstrap": 200, "particles": 1000},
        seconds=143.2,
    )  # fmt: skip


def none_of_these():
    """Something is missing that no effect explains; a curve over two variables."""
    found = effect_found()
    x = np.linspace(-1.5, 1.5, 31)
    wave = 0.4 * np.sin(3 * x)
    causes = found.causes.assign(p=[0.08, 0.09, 0.2, 0.3, 0.4, 0.6, 1, 1, 1], class_id=range(9))
    closed = tabulate("closed", [
        dict(effect="the estimated curve", F=0.62, F_low=0.41, F_high=0.83, nats_per_sample=0.05,
             gain_mean=13.0, gain_noise=1.5, rmse_before=0.21, rmse_after=0.13),
    ])  # fmt: skip
    curves = [dict(equation="v", variable="x", value=a, estimate=b, low=b - 0.1, high=b + 0.1)
              for a, b in zip(x, wave, strict=True)]  # fmt: skip
    curves += [dict(equation="v", variable="u", value=a, estimate=0.02 * a, low=0.02 * a - 0.07,
                    high=0.02 * a + 0.07) for a in x]  # fmt: skip
    return dataclasses.replace(
        found, verdict="none of these", chosen=[], causes=causes, closed=closed,
        classes=tabulate("classes"), missing=tabulate("missing", curves),
    )  # fmt: skip


def no_gap():
    """Nothing stands out."""
    found = effect_found()
    lost = {"F": NAN, "F_low": NAN, "F_high": NAN, "nats_per_sample": -0.001}
    return dataclasses.replace(
        found, verdict="no measurable gap", chosen=[], model_text="", missing=None,
        causes=found.causes.assign(p=[0.43, 0.5, 0.6, 0.8, 0.9, 1, 1, 1, 1], z=1.2),
        classes=tabulate("classes"), where=found.where.assign(p=0.43, z=1.7),
        detection=found.detection.assign(p=[0.99, 0.8, 0.5, 0.6]),
        closed=found.closed.head(1).assign(**lost),
        residual_map=residual_map(["x", "v", "y"], 1000, 20, {}),
        free_run=found.free_run.assign(after=NAN, after_low=NAN, after_high=NAN),
        estimates={"before": found.estimates["before"]},
        notes=["the lower bound of the reference's gain is not above zero, so no share is given"],
    )  # fmt: skip


def fast():
    """The screen only."""
    found = effect_found()
    return dataclasses.replace(
        found, mode="fast", closed=tabulate("closed"), chosen=[], model_text="",
        causes=found.causes.assign(gain_refit=NAN), parts={"screen": (1, 1000)}, seconds=12.1,
        free_run=found.free_run.assign(after=NAN, after_low=NAN, after_high=NAN),
        estimates={"before": found.estimates["before"]},
    )  # fmt: skip


def several():
    """Two effects, many equations, a class of five, two experiments, two channels, parts left out,
    names that HTML would take for tags."""
    found = effect_found()
    causes = found.causes.assign(
        equation=["speed[0]", "speed[1]", "speed[1]", "u1", "u1", "speed[0]", "z<1>", "z<1>", "z2"],
        effect=["coulomb friction", "coulomb friction", "stribeck", "input saturation",
                "dead zone", "cubic stiffness", "sensor bias", "outliers", "sensor lag"],
        form=["a form so long that it cannot be printed in one line of the table " * 2, *[""] * 8],
        class_id=[1, 2, 2, 3, 3, 3, 3, 3, 4],
    )  # fmt: skip
    classes = [dict(class_id=c, effect=e, equation=q, rho=0.93, separating_input=s)
               for c, e, q, s in zip(causes.class_id, causes.effect, causes.equation,
                                     ["", *["a step of u2"] * 2, *[""] * 6],
                                     strict=True)]  # fmt: skip
    t, observed, before, after = oscillation(500)
    runs = {name: (t, {"z<1>": (observed + i, before + i, after + i),
                       "z2": (2 * observed, 2 * before, 2 * after)})
            for i, name in enumerate(("day 1", "day 2"))}  # fmt: skip
    equations = [*(f"speed[{i}]" for i in range(2)), "pulley", "spring", "z<1>", "z2", "initial"]
    return dataclasses.replace(
        found,
        chosen=["coulomb friction on speed[0]", "coulomb friction on speed[1]"],
        causes=causes, classes=tabulate("classes", classes),
        where=found.where.assign(equation=["speed[1]", "z<1>"], p=[0.001, 0.02],
                                 experiment=["1", "1 to 2"]),
        closed=tabulate("closed", [
            dict(effect="coulomb friction in speed[0] and in speed[1]", F=1.08, F_low=0.4,
                 F_high=float("inf"), nats_per_sample=0.02, rmse_before=0.2, rmse_after=0.22),
        ]),
        residual_map=pd.concat([
            residual_map(equations, steps, windows, strong).assign(experiment=name)
            for steps, windows, strong, name in ((500, 15, {"speed[1]": (3, 9)}, "1"),
                                                 (300, 9, {"z<1>": (2, 4)}, "2"))
        ], ignore_index=True),
        free_run=free_run(runs),
        not_applicable=tabulate("not_applicable", [
            dict(part="derivatives", equation="", reason="the model calls an @ssm.primitive: "
                 "central differences under common random numbers were taken"),
            dict(part="input delay", equation="u2", reason="u2 is constant in these data"),
            dict(part="outliers", equation="z2", reason="z2 counts (Poisson)"),
        ]),
        notes=["the data of <day 2> hold 31 missing values & were used as they are"],
        parts={"cross-fitting": 5, "reason": "500 rows are too few for three parts"},
    )  # fmt: skip


def break_of_level():
    """A break in a level, by year, cross-fitted: what the Nile should look like."""
    found = effect_found()
    years = np.arange(1871, 1971)
    rng = np.random.default_rng(7)
    level = np.where(years < 1899, 1098.0, 850.0)
    observed = level + 125 * rng.standard_normal(100)
    runs = {"1": (years, {"flow": (observed, np.full(100, 919.0), level)})}
    causes = [dict(effect="parameter break", form="from 1899 on", equation="level", z=5.1, p=0.0007,
                   gain_screen=13.0, gain_refit=14.2, class_id=1, sign="±", estimate=-247.8,
                   se=28.1, kind="change in time")]  # fmt: skip
    return dataclasses.replace(
        found, chosen=["parameter break"], missing=None, parts={"cross-fitting": 10},
        where=tabulate("where", [dict(equation="level", moment="mean", t_from=1898, t_to=1899,
                                      region="", z=5.1, p=0.0007)]),
        causes=tabulate("causes", causes), classes=tabulate("classes"),
        closed=found.closed.head(1).assign(effect="parameter break of level", F_low=-np.inf,
                                           rmse_before=167.2, rmse_after=125.4),
        detection=tabulate("detection"), not_applicable=tabulate("not_applicable"),
        residual_map=residual_map(["level", "flow"], 100, 10, {"level": (2, 3)}, first=1871),
        free_run=free_run(runs, width=130.0),
        settings=found.settings | {"model": "Nile", "candidates": 14, "samples": 100},
    )  # fmt: skip


def separation(*nats, recorded=0.8, records=1, **changes):
    """Two rivals over 400 rows of u, and of w that stays; triangles of u with these ratios, and
    three signals that have none."""
    rows = 400
    before = np.column_stack([2.0 * sine(rows, 23) - 1.0, np.full(rows, 0.5)])
    tried = [
        Tried("u", Signal("triangle", f"a triangle of u between −1 and 1 with a period of {40 + k} "
                          "rows", 2.0 * triangle(rows, 40 + k) - 1.0), value)
        for k, value in enumerate(nats)
    ]  # fmt: skip
    tried += [Tried("u", Signal("constant", f"u held at {k}", np.full(rows, float(k))), NAN, note)
              for k, note in enumerate((OUTSIDE, ALIKE, BEHIND))]  # fmt: skip
    found = Separation(
        (("quadratic drag", "v"), ("state-dependent damping", "v")), 2, recorded, before, records,
        tuple(tried),
    )  # fmt: skip
    if found.runs:
        inputs = np.column_stack([found.best.signal.values, before[:, 1]])
        found = dataclasses.replace(found, inputs=inputs)
    return dataclasses.replace(found, **changes)


def with_experiment(found=None):
    """Rivals that an experiment would tell apart."""
    found = separation(7.2, 3.1) if found is None else found
    report, table = effect_found(), None
    if found.inputs is not None:
        table = pd.DataFrame(found.inputs, columns=["u", "w"])
    return dataclasses.replace(
        report, separation=found, signals=signals_table(found), experiment=table
    )


def recovered():
    """Of the two leading effects the first is taken for the second in three sets of ten."""
    rivals = [("quadratic drag", "v", 0.0, 1.2), ("state-dependent damping", "v", 1.5, 0.8)]
    shares = [[0.7, 0.3], [0.1, 0.9]]
    return dataclasses.replace(effect_found(), probabilities=tabulate("probabilities", [
        dict(effect=e, equation=q, behind=b, cut=c, named=rivals[j][0], named_equation=rivals[j][1],
             probability=shares[i][j])
        for i, (e, q, b, c) in enumerate(rivals) for j in range(2)
    ]))  # fmt: skip


ALL = {
    f.__name__: f
    for f in (
        effect_found, none_of_these, no_gap, fast, several, break_of_level, with_experiment,
        recovered,
    )
}  # fmt: skip


def oscillation(steps):
    """Rows, measured position, and free runs without and with the drag that the machine has."""

    def run(drag, k):
        x, v, out = 1.0, 0.0, []
        for i in range(steps):
            u = np.sin(0.011 * i) * np.cos(0.17 * i) * 6
            v += 0.05 * (u - k * x) - 0.05 * drag * v * abs(v) - 0.01 * v
            x += 0.05 * v
            out.append(x)
        return np.array(out)

    noise = 0.04 * np.random.default_rng(3).standard_normal(steps)
    return np.arange(1, steps + 1), run(0.3, 10) + noise, run(0, 9.4), run(0.28, 9.97)


def residual_map(equations, steps, windows, strong, first=1):
    """Standard normal z, and 3 to 6 in the named windows."""
    rng = np.random.default_rng(11)
    edges = first + np.linspace(0, steps, windows + 1).astype(int)
    rows = []
    for name in equations:
        low, high = strong.get(name, (0, 0))
        for i in range(windows):
            z = rng.standard_normal() + (rng.uniform(3, 6) if low <= i < high else 0.0)
            rows.append(dict(equation=name, t_from=edges[i], t_to=edges[i + 1] - 1, z=z,
                             experiment=""))  # fmt: skip
    return tabulate("residual_map", rows)


def free_run(runs, width=0.15):
    """{experiment: (rows, {channel: (observed, before, after)})} as the table of a report."""
    rows = []
    for name, (times, channels) in runs.items():
        for channel, curves in channels.items():
            for t, y, b, a in zip(times, *curves, strict=True):
                rows.append(dict(experiment=name, t=t, channel=channel, observed=y, before=b,
                                 before_low=b - 2 * width, before_high=b + 2 * width, after=a,
                                 after_low=a - width, after_high=a + width))  # fmt: skip
    return tabulate("free_run", rows)
