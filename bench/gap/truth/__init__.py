"""The true systems: generators with effects that are switched on, and never told.

Nothing under `systems/` imports from here; `run.py` does not either.
"""

from bench.gap.truth import (
    cart_pole,
    cascade,
    chemostat,
    epidemic,
    hot_plate,
    motor_belt,
    oscillator,
    pendulum,
    predator_prey,
    servo,
    ship_steering,
    swing,
    thermal,
    two_tanks,
)
from bench.gap.truth.system import Effect, System

SYSTEMS: dict[str, System] = {
    module.SYSTEM.name: module.SYSTEM
    for module in (
        oscillator, pendulum, cart_pole, two_tanks, thermal, motor_belt, predator_prey, epidemic,
        servo, cascade, hot_plate, ship_steering, swing, chemostat,
    )
}  # fmt: skip

__all__ = ["SYSTEMS", "Effect", "System"]
