"""A small motor in a loop, with an encoder and dry friction: scales of 1e-5, a shaft that rests."""

import numpy as np

import ssmppl as ssm

DT = 0.002
PARTS = {"R": 2.0, "K": 0.05, "J": 1e-5, "b": 1e-5, "dry": 3e-3}  # ohm, N m / A, kg m2, N m s, N m


def model(friction):
    """The shaft, integrated over a row; its angle is measured. With friction, what is slower than l
    comes to rest."""
    made = ssm.Model("dc motor", inputs=("voltage",))
    names = ("J", "b", "l", "q", "r") if friction else ("J", "b", "q", "r")
    made.prior(lambda: {n: ssm.HalfFlat() for n in names})
    made.initial(lambda: {"th": ssm.Normal(0, sd=0.01), "om": ssm.Normal(0, sd=0.1)})

    def plain(th, om, voltage, J, b, q):
        return moved(th, om, voltage, J, b, q, lambda new: 0.0)

    def held(th, om, voltage, J, b, l, q):
        return moved(th, om, voltage, J, b, q, lambda new: -np.clip(new, -l, l))

    made.transition(held if friction else plain)
    made.observation(lambda th, r: {"angle": ssm.Normal(th, sd=r)})
    return made


def moved(th, om, voltage, J, b, q, change):
    """The step, with a change of the new speed, of which half has moved the shaft by then."""

    def rhs(th, om):
        current = (voltage - PARTS["K"] * om) / PARTS["R"]
        return {"th": om, "om": (PARTS["K"] * current - b * om) / J}

    new = ssm.integrate(rhs, {"th": th, "om": om}, DT)
    by = change(new["om"])
    return {"th": ssm.Dirac(new["th"] + DT / 2 * by), "om": ssm.Normal(new["om"] + by, sd=q)}


def measured(seed, rows=1500, within=40):
    """What such a motor does in a loop: Coulomb's law in short steps, 2,000 counts a turn."""
    rng, h, count = np.random.default_rng(seed), DT / within, 2.0 * np.pi / 2000.0
    wanted = np.repeat(rng.uniform(-1.5, 1.5, rows // 75), 75)
    resistance, k, inertia, b, dry = PARTS.values()
    th = om = before = 0.0
    voltage, angle = np.zeros(rows), np.zeros(rows)
    for t in range(rows):
        angle[t] = np.round(th / count) * count
        voltage[t] = np.clip(2.0 * (wanted[t] - angle[t]) - 0.02 * (angle[t] - before) / DT, -6, 6)
        before = angle[t]
        for _ in range(within):
            pull = k * (voltage[t] - k * om) / resistance - b * om
            if om == 0.0 and abs(pull) <= dry:
                continue
            new = om + h * (pull - dry * np.sign(om or pull)) / inertia
            om = 0.0 if om * new < 0.0 else new
            th += h * om
    return {"voltage": voltage, "angle": angle}


def taken_in_a_row():
    """Speed that the friction takes in a row, as the shaft's own damping goes on meanwhile."""
    lag = PARTS["J"] / (PARTS["K"] ** 2 / PARTS["R"] + PARTS["b"])
    return PARTS["dry"] / PARTS["J"] * lag * (1.0 - np.exp(-DT / lag))
