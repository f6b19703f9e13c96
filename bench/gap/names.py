"""The one place where withheld effects meet the catalogue's names.

Keys are the items that `bench.gap.truth` uses; values the canonical names that count as right: the
item itself first. A second name stands only where the catalogue has two items for one mechanism.
"""

from __future__ import annotations

ITEMS: dict[str, tuple[str, ...]] = {
    "coulomb friction": ("coulomb friction",),
    "stribeck": ("stribeck",),
    "asymmetric friction": ("asymmetric friction",),
    "load-dependent friction": ("load-dependent friction",),
    "quadratic drag": ("quadratic drag",),
    "cubic stiffness": ("cubic stiffness",),
    "state-dependent damping": ("state-dependent damping",),
    "hard stop": ("hard stop",),
    "cross-coupling": ("cross-coupling",),
    "extra loss": ("extra loss",),
    "constant load": ("constant load",),
    "bouc-wen hysteresis": ("bouc-wen hysteresis",),
    "input saturation": ("input saturation",),
    "dead zone": ("dead zone",),
    "input asymmetry": ("input asymmetry",),
    "backlash": ("backlash",),
    "input delay": ("input delay",),
    "actuator lag": ("actuator lag",),
    "missing input": ("missing input",),
    "periodic forcing": ("periodic forcing",),
    "parameter drift": ("parameter drift",),
    "parameter break": ("parameter break",),
    "sensor drift": ("sensor drift",),
    "sensor gain nonlinearity": ("sensor gain nonlinearity",),
    "sensor clipping": ("sensor clipping",),
    "sensor lag": ("sensor lag", "sensor delay"),
    "outliers": ("outliers",),
    "heteroscedastic noise": ("heteroscedastic noise",),
    "coloured noise": ("coloured noise",),
    "coarse discretisation": ("coarse discretisation",),
}

# What describes that something is missing, and names no mechanism; and what changes in time.
UNKNOWN = {"missing input", "coloured noise", "outliers", "heteroscedastic noise",
           "parameter random walk"}  # fmt: skip
CHANGES = {"parameter drift", "parameter break", "level break", "sensor drift"}
