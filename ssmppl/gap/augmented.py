"""A traced model with effects added, which remembers the model as it was.

What an effect is bound to (the state that integrates a rate, how far that moves in a step, what
moves along) is read off the model as it was: with the terms of another effect in its equations a
position is no plain integral any more, and means, steps and inputs are others. So a further effect
is added to the model as it was, beside those that are in already, and means the same as if all had
been added at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from ssmppl.gap.candidate import Candidate
from ssmppl.language.traced import Trace


@dataclass(frozen=True)
class Augmented(Trace):
    """What `augment` makes.

    origin : the model as it was. added : the effects, in the order in which they were added.
    names : strength -> the names of its auxiliary states in the model.
    """

    origin: Trace | None = None
    added: tuple[Candidate, ...] = ()
    names: Mapping[str, Mapping[str, str]] = field(default_factory=dict)


def as_it_was(trace: Trace) -> Trace:
    """The model without what was added to it; itself where nothing was."""
    if isinstance(trace, Augmented) and trace.origin is not None:
        return trace.origin
    return trace
