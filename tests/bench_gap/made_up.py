"""A made-up report with the tables of gap.md, and answers to score it against."""

from types import SimpleNamespace

import pandas as pd


def report(verdict="effect", causes=(), classes=(), closed=(), chosen=(), p=0.001):
    """causes : (effect, equation, class_id, p, gain) each. closed : (effect, F, low, high)."""
    causes = pd.DataFrame(
        [
            {"effect": e, "form": "", "equation": q, "z": 4.0, "p": p_k, "gain_screen": g,
             "gain_refit": float("nan") if k else g, "class_id": c, "sign": 1, "estimate": 0.1,
             "se": 0.02}
            for k, (e, q, c, p_k, g) in enumerate(causes)
        ],
        columns=["effect", "form", "equation", "z", "p", "gain_screen", "gain_refit", "class_id",
                 "sign", "estimate", "se"],
    )  # fmt: skip
    return SimpleNamespace(
        verdict=verdict,
        causes=causes,
        classes=pd.DataFrame(classes, columns=["class_id", "effect", "equation", "rho"]),
        closed=pd.DataFrame(closed, columns=["effect", "F", "F_low", "F_high"]),
        detection=pd.DataFrame({"channel": ["y"], "p": [p]}),
        chosen=list(chosen),
        model_text="",
        estimates={"before": {"k": (1.0, 0.1)}},
        seconds=12.0,
        mode="full",
    )


def answer(cell, *effects, id="t000"):
    """effects : (names, equations) each."""
    return {
        "id": id,
        "cell": cell,
        "effects": [{"names": list(n), "equations": list(q)} for n, q in effects],
    }
