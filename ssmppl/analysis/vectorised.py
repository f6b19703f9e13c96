"""Expr -> a function of arrays, by way of its text: each operation one call of NumPy.

For what is evaluated row after row at many points at once, where a walk over the graph would take
longer than its arithmetic. Simulators are called once for all that is wanted of them at the same
arguments. The interpreter (`expressions/evaluate.py`) defines the meaning.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ssmppl.expressions.batched.call import OP, groups, of_group
from ssmppl.expressions.evaluate import MEANING, evaluate
from ssmppl.expressions.expr import Expr, topological

Function = Callable[[Sequence[Any]], list[Any]]


def vectorised(expressions: Sequence[Expr], arguments: Sequence[Expr]) -> Function:
    """A function of the arguments' values, numbers or arrays that broadcast, in one sequence, that
    gives a list of values."""
    order = topological(expressions)
    together = groups(order)
    text = {a: f"v[{i}]" for i, a in enumerate(arguments)}
    home: dict[str, Any] = {}
    lines = ["def run(v):"]
    for k, node in enumerate(order):
        if node in text:
            continue
        parts = [text[a] for a in node.args]
        name = f"a{k}"
        if node.op == "const":
            home[f"c{k}"] = node.data
            text[node] = f"c{k}"
            continue
        if node.op == "symbol":
            raise KeyError(f"no value given for {node!r}")
        if node.op == OP:
            group = together[node]
            names = [f"{name}_{i}" for i in range(len(group))]
            home[f"g{k}"] = _caller(group)
            lines.append(f"    {', '.join(names)}, = g{k}(({', '.join(parts)},))")
            text |= dict(zip(group, names, strict=True))
            continue
        if node.op == "item" and node.args[0].op == OP:
            written = f"{parts[0]}[..., {node.data[0]}]"
        elif node.op in MEANING and node.op not in ("cholesky", "inverse", "logdet", "det"):
            home[f"op_{node.op}"] = MEANING[node.op]
            written = f"op_{node.op}({', '.join(parts)})"
        else:
            home[f"g{k}"] = _interpreted(node)
            written = f"g{k}(({''.join(f'{p}, ' for p in parts)}))"
        lines.append(f"    {name} = {written}")
        text[node] = name
    lines.append(f"    return [{', '.join(text[e] for e in expressions)}]")
    exec("\n".join(lines), home)
    run: Function = home["run"]
    return run


def _caller(group: Sequence[Expr]) -> Callable[[Sequence[Any]], list[np.ndarray]]:
    return lambda args: of_group(group, args)


def _interpreted(node: Expr) -> Callable[[Sequence[Any]], Any]:
    """One operation, by the interpreter."""

    def run(args: Sequence[Any]) -> Any:
        return evaluate([node], dict(zip(node.args, args, strict=True)))[0]

    return run
