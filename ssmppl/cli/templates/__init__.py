"""Models to begin with: what `ssmppl new` writes. Each is a module here, and runs as it stands."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

import numpy as np

from ssmppl.cli.templates import counts, inputs, scalar, vector
from ssmppl.language.model.model import Model

__all__ = ["TEMPLATES", "Template", "skeleton"]

NAME, SIMULATE = "NAME", "SIMULATE"  # stand in the templates for what `skeleton` puts there


@dataclass(frozen=True)
class Template:
    """A model, and how the data beside it are simulated.

    parameters : their values, by name. inputs : (T,) of each input, by name; else `steps` rows.
    """

    module: ModuleType
    parameters: Mapping[str, Any]
    steps: int = 200
    inputs: Mapping[str, np.ndarray] = field(default_factory=dict)
    seed: int = 1

    @property
    def model(self) -> Model:
        model: Model = self.module.model
        return model


HEAT = np.repeat([0.0, 1.0, 0.0, 2.0, 1.0, 0.0, 2.0, 0.0], 25)  # steps, each long enough to settle

TEMPLATES = {
    "scalar": Template(scalar, {"a": 0.9, "q": 0.2, "r": 0.5}),
    "vector": Template(vector, {"q": 0.01, "r": 0.5}),
    "counts": Template(counts, {"level": 1.5, "phi": 0.9, "q": 0.05}),
    "inputs": Template(inputs, {"loss": 0.1, "gain": 1.0, "q": 0.02, "r": 0.2},
                       inputs={"u": HEAT}),
}  # fmt: skip


def skeleton(template: str, name: str) -> str:
    """The text of a model file called `name`."""
    kind = TEMPLATES[template]
    values = " ".join(f"{key}={value:g}" for key, value in kind.parameters.items())
    rows = f"--inputs {name}.csv" if kind.inputs else f"--steps {kind.steps}"
    how = f"ssmppl simulate {name}.py {rows} -p {values} --seed {kind.seed} -o again.csv"
    return inspect.getsource(kind.module).replace(SIMULATE, how).replace(NAME, name)
