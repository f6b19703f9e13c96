"""Methods by the names that the command line has for them, with their settings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import click

import ssmppl as ssm
from ssmppl.errors import ArgumentError, listing
from ssmppl.modelfile import parse_settings

__all__ = ["CLIMBERS", "SAMPLERS", "method_of"]

SAMPLERS: dict[str, type] = {
    "mh": ssm.MetropolisHastings, "gibbs": ssm.Gibbs, "pmmh": ssm.PMMH, "pgas": ssm.PGAS,
    "smc2": ssm.SMC2,
}  # fmt: skip
CLIMBERS: dict[str, type] = {
    "do": ssm.DirectOptimization, "score": ssm.ScoreAscent, "em": ssm.EM,
    "particle-em": ssm.ParticleEM, "psaem": ssm.PSAEM, "if2": ssm.IF2,
}  # fmt: skip


def method_of(
    kinds: Mapping[str, type], name: str | None, settings: Sequence[str] = (),
    particles: int | None = None,
) -> Any:  # fmt: skip
    """The method of this name with its settings; None where none is named.

    Raises
    ------
    click.UsageError : settings without a method, or particles for one without particles.
    ArgumentError : the method has no such setting.
    """
    given = parse_settings(settings, "--settings")
    if particles is not None:
        with_particles = [n for n, k in kinds.items() if "particles" in _names(k)]
        if name not in with_particles:
            *most, last = with_particles
            raise click.UsageError(f"--particles needs --method {', '.join(most)} or {last}.")
        given["particles"] = particles
    if name is None:
        if given:
            raise click.UsageError("--settings needs --method: they are settings of it.")
        return None
    kind = kinds[name]
    for setting in given:
        if setting not in _names(kind):
            raise ArgumentError(
                f"--settings: {kind.__name__} has no setting {setting!r}",
                fix=f"it has: {listing(setting, _names(kind))}",
            )
    return kind(**given)


def _names(kind: type) -> list[str]:
    return [field.name for field in fields(kind)]
