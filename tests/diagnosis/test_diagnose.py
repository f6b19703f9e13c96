"""`ssm.diagnose` from end to end, on small data: what it finds, keeps, resumes and refuses."""

import re
import warnings

import numpy as np
import pandas as pd
import pytest

import ssmppl as ssm
import ssmppl.datasets
from ssmppl.diagnosis import diagnose
from ssmppl.diagnosis.heldout import cross_validation
from ssmppl.diagnosis.run.expected_time import Timed, in_words, seconds
from ssmppl.diagnosis.screening import screen
from ssmppl.diagnosis.selection import effect_selection, refit
from ssmppl.errors import ArgumentError, DataError
from tests.diagnosis.small import BREAK, DATE, fished, fished_data, level, levels
from tests.models import gaps as models

FEW = 60  # simulated sets, in place of 100 or 200
EFFECTS = ["level break", "sensor drift"]


BLOCKS = 5


@pytest.fixture(autouse=True)
def few_sets(monkeypatch):
    _few(monkeypatch)


def _few(patch):
    patch.setattr(diagnose, "SETS", {"fast": FEW, "full": FEW})
    patch.setattr(cross_validation, "SETS", FEW)
    patch.setattr(cross_validation, "SINGLES", 1)
    for module in (diagnose, cross_validation):
        patch.setattr(module, "FOLDS", BLOCKS)


def run(model=None, data=None, effects=EFFECTS, **kwargs):
    kwargs = {"progress": False, "particles": 200, **kwargs}
    return ssm.diagnose(model or level(), levels(80) if data is None else data, effects, **kwargs)


def same(one, other):
    """Two reports without their run times."""
    assert one.verdict == other.verdict
    assert one.notes == other.notes
    assert one.estimates == other.estimates
    assert one.model_text == other.model_text
    for name, table in one.tables().items():
        pd.testing.assert_frame_equal(table, other.tables()[name])


# --- full mode on a short record: a jump, kept, interrupted and resumed ---------------------------


@pytest.fixture(scope="module")
def jump():
    """The full report on data with a jump, made in one go."""
    with pytest.MonkeyPatch.context() as patch:
        _few(patch)
        return run(level(), levels(80, BREAK))


@pytest.mark.slow
def test_a_jump_is_found_with_its_date_and_size(jump):
    assert jump.verdict == "effect"
    assert jump.chosen == ["level break"]
    best = jump.causes.iloc[0]
    assert (best["effect"], best["equation"]) == ("level break", "x")
    assert f"date = {DATE}" in best["form"].split(", ")
    assert abs(best["estimate"] - BREAK) <= 4.0 * best["se"] <= 4.0
    assert best["p"] <= 0.05
    assert jump.parts == {"cross-fitting": BLOCKS}


@pytest.mark.slow
def test_the_share_is_of_rows_left_out(jump):
    row, *ahead = jump.closed.to_dict("records")
    assert row["horizon"] == "free run"
    assert ahead[-1]["horizon"].startswith("1 to ")
    assert all(r["rmse_before"] > 0.0 for r in ahead)
    assert row["effect"] == "level break"
    # With five folds of which one holds the break, the reference's own gain may be uncertain.
    # Most of the gain is in the block of the jump: five blocks need not bound the share.
    assert np.isnan(row["F"]) or row["F_low"] <= row["F"] <= row["F_high"]
    assert row["nats_per_sample"] > 0.0
    assert row["rmse_after"] < row["rmse_before"]
    np.testing.assert_allclose(
        row["gain_mean"] + row["gain_noise"], 80 * row["nats_per_sample"], rtol=1e-9
    )


@pytest.mark.slow
def test_the_augmented_model_has_the_gain_of_the_refit(jump):
    data = levels(80, BREAK)
    value = {when: {n: v for n, (v, _) in found.items() if not n.endswith("_date")}
             for when, found in jump.estimates.items()}  # fmt: skip
    before = ssm.log_likelihood(level(), data, value["before"])[0]
    after = ssm.log_likelihood(jump.model, data, value["after"])[0]
    assert after - before == pytest.approx(jump.causes.iloc[0]["gain_refit"], abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["refit", pytest.param("share", marks=pytest.mark.slow)])
def test_an_interrupt_keeps_the_stages_that_are_done(jump, tmp_path, monkeypatch, stage):
    def interrupted(*args, **kwargs):
        raise KeyboardInterrupt

    kept = tmp_path / "stages"
    where = {"refit": (refit, "refit"), "share": (cross_validation.CrossValidation, "_one")}[stage]
    with monkeypatch.context() as patch:
        patch.setattr(*where, interrupted)
        first = run(level(), levels(80, BREAK), checkpoint=kept)
    assert first.interrupted
    assert first.closed.empty
    assert first.causes["gain_refit"].notna().any() == (stage == "share")
    with monkeypatch.context() as patch:  # the screen is not asked again
        patch.setattr(screen.ScreenDesign, "statistics", _only_later(patch))
        second = run(level(), levels(80, BREAK), checkpoint=kept)
    assert not second.interrupted
    same(second, jump)


def _only_later(patch):
    """`ScreenDesign.statistics`, forbidden until the refits have begun."""
    begun, original, selected = (
        [],
        screen.ScreenDesign.statistics,
        effect_selection.EffectSelection.run,
    )

    def statistics(self, *args, **kwargs):
        assert begun, "a simulated set of the first screen was drawn again"
        return original(self, *args, **kwargs)

    def later(*args, **kwargs):
        begun.append(True)
        return selected(*args, **kwargs)

    patch.setattr(effect_selection.EffectSelection, "run", later)
    return statistics


# --- fast mode -----------------------------------------------------------------------------------


def test_the_screen_resumes_where_it_was_interrupted(tmp_path, monkeypatch):
    count, original = [], screen.ScreenDesign.statistics

    def statistics(self, *args, **kwargs):
        count.append(1)
        if len(count) == 25:
            raise KeyboardInterrupt
        return original(self, *args, **kwargs)

    kept = tmp_path / "kept.npz"
    with monkeypatch.context() as patch:
        patch.setattr(screen.ScreenDesign, "statistics", statistics)
        with pytest.raises(KeyboardInterrupt):
            run(mode="fast", checkpoint=kept)
        before = len(count)
        resumed = run(mode="fast", checkpoint=kept)
    assert len(count) - before < FEW
    same(resumed, run(mode="fast"))
    assert resumed.verdict in ("effect", "no measurable gap")


def test_a_checkpoint_of_something_else_is_refused(tmp_path):
    kept = tmp_path / "kept.npz"
    run(mode="fast", checkpoint=kept)
    for changes, said in (
        ({"data": levels(80, 1.0)}, "other data"),
        ({"seed": 2}, "other settings"),
        ({"fixed": {"q": 0.1}}, "other settings"),
        ({"effects": ["level break"]}, "another set of effects"),
        ({"model": level(ssm.Normal(0, sd=3))}, "another model"),
    ):
        with pytest.raises(ArgumentError, match=f"was made with {said}"):
            run(mode="fast", checkpoint=kept, **changes)


def test_stages_and_their_time_are_said(capsys):
    run(mode="fast", progress=True)
    said = capsys.readouterr().err
    assert re.search(r"fitting 'level'\n.*fast mode: about \d+ (s|min) expected", said)
    assert f"screening: 100% {FEW + screen.OWN_RUNS}/{FEW + screen.OWN_RUNS}" in said


def test_expected_time():
    class One:
        _max_workers = 1

    found = Timed(0.1, 0.05, 10.0)
    assert seconds(found, 200, "fast", 0, One()) == pytest.approx(20.0)
    three, crossed = (seconds(found, 200, "full", k, One()) for k in (0, 10))
    assert 20.0 < three < crossed
    assert [in_words(v) for v in (0.1, 42.0, 170.0, 9000.0)] == [
        "about 5 s", "about 40 s", "about 3 min", "about 2.5 h",
    ]  # fmt: skip


def test_the_same_seed_gives_the_same_report():
    same(run(mode="fast", seed=3), run(mode="fast", seed=3))


def test_known_parameters_stay():
    report = run(mode="fast", fixed={"q": 0.1})
    assert report.estimates["before"]["q"] == (0.1, 0.0)
    assert report.estimates["before"]["r"][1] > 0.0


@pytest.mark.slow
def test_a_flat_start():
    """Where the level starts says nothing about a jump: the data may lie anywhere."""
    found = [run(level(ssm.Flat()), {"y": levels(80, BREAK)["y"] + shift}, ["level break"],
                 mode="fast") for shift in (0.0, 500.0)]  # fmt: skip
    for report in found:
        assert f"date = {DATE}" in report.causes.iloc[0]["form"]
    np.testing.assert_allclose(*(r.causes["z"] for r in found), rtol=1e-3)


def _vector():
    data = models.simulated("vector", 70)
    data["y"][5:9, 0] = np.nan
    data["y"][20:23] = np.nan
    return models.build("vector"), data, {"b": np.array([0.5, 0.0])}


def _simulator():
    return models.build("simulator"), models.simulated("simulator", 70), {}


def _several():
    return level(), [levels(40, 0.0, k) for k in range(3)], {}


def _counts():
    data = models.simulated("epidemic", 70)
    data["cases"] = np.where(np.arange(70) == 10, np.nan, data["cases"])
    return models.build("epidemic"), data, {}


@pytest.mark.parametrize(
    "case",
    [_several, *(pytest.param(c, marks=pytest.mark.slow) for c in (_vector, _simulator, _counts))],
)
def test_any_model_is_screened(case):
    """Several states with missing values and known parameters; a simulator without process noise;
    several experiments; counts."""
    model, data, fixed = case()
    report = run(model, data, ["constant load", "sensor bias", "outliers"], mode="fast",
                 fixed=fixed or None)  # fmt: skip
    assert not report.causes.empty
    assert np.isfinite(report.causes["z"]).all()
    assert report.causes["p"].between(0.0, 1.0).all()
    assert report.detection["p"].between(0.0, 1.0).all()
    rows = [len(next(iter(d.values()))) for d in (data if isinstance(data, list) else [data])]
    assert report.settings["samples"] == sum(rows)


@pytest.mark.parametrize("number", [1, 3])
def test_a_fit_that_mostly_leaves_its_domain_is_screened(number):
    """Of a fished stock most simulated records die out: there was no screen at all, and where a few
    of them had survived until the last rows they alone made every variance; predictions further
    ahead, of 3, went to 1e200."""
    model, data = fished(), fished_data(number)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # an overflow among them
        report = run(model, data, ["constant load"], mode="fast", particles=None, seed=1)
    assert report.verdict == "no measurable gap"
    assert not report.causes.empty
    assert np.isfinite(report.detection["z"]).all()
    assert any("leave its domain" in note for note in report.notes)


# --- errors --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"mode": "quick"}, "mode='quick'"),
        ({"alpha": 0.0}, "alpha=0.0"),
        ({"particles": 3}, "particles=3"),
        ({"horizon": 0}, "horizon=0"),
        ({"effects": ["level brake"]}, "level brake"),
        ({"effects": ["input delay"]}, "none of the effects applies"),
        ({"fixed": {"mass": 1.0}}, "mass"),
        ({"seed": -1}, "seed=-1"),
    ],
)
def test_what_is_wrong_with_the_call_is_said(changes, said):
    with pytest.raises(ArgumentError, match=re.escape(said)) as error:
        run(**{"mode": "fast", **changes})
    assert error.value.fix


def test_what_is_wrong_with_the_data_is_said():
    with pytest.raises(DataError):
        run(data={"z": np.zeros(10)})


# --- the Nile ------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_sensor_that_gives_the_size_only():
    """Driven to and fro, and |speed| measured: the fitted model never changes the sign of its
    speed, so that no score tells of the fold. Fitted anew with it, the model is right: as good as
    the true one at the true parameters, and with the true gain."""
    values, rng = {"a": 0.9, "b": 0.3, "q": 0.05, "r": 0.1}, np.random.default_rng(3)

    def declared(fold):
        model = ssm.Model("speed", inputs=("u",))
        model.prior(lambda: {
            "a": ssm.Uniform(0, 1), "b": ssm.LogNormal(-1, sd=1), "q": ssm.LogNormal(-2, sd=1),
            "r": ssm.LogNormal(-2, sd=1),
        })  # fmt: skip
        model.initial(lambda: {"v": ssm.Normal(0, sd=0.1)})
        model.transition(lambda v, u, a, b, q: {"v": ssm.Normal(a * v + b * u, sd=q)})
        if fold:
            model.observation(lambda v, r: {"y": ssm.Normal(np.abs(v), sd=r)})
        else:
            model.observation(lambda v, r: {"y": ssm.Normal(v, sd=r)})
        return model

    u = np.repeat(rng.choice([-1.0, 1.0], 40) * rng.uniform(0.5, 1.0, 40), 10)
    drawn = ssm.simulate(declared(True), values, inputs={"u": u}, seed=4)
    data = {"y": drawn["y"].values[0], "u": u}
    report = run(
        declared(False), data, ["sensor rectification", "constant load", "cubic stiffness"]
    )
    assert report.verdict == "effect"
    assert report.chosen[0] == "sensor rectification"
    head = report.causes.iloc[0]
    assert head["effect"] == "sensor rectification"
    assert head["p"] < 0.01
    after = {n: v for n, (v, _) in report.estimates["after"].items()}
    assert after["sensor_rectification_y"] > 0.9
    assert after["b"] / (1.0 - after["a"]) == pytest.approx(3.0, rel=0.05)
    whole = [ssm.log_likelihood(m, data, v, particles=1000, seed=1)
             for m, v in ((report.model, after), (declared(True), values))]  # fmt: skip
    assert whole[0] > whole[1] - 3.0  # fitted to the first 70% only


@pytest.mark.slow
def test_the_dam_at_aswan(monkeypatch):
    """A level that jumps in the step from 1898 to 1899 and is constant otherwise (Cobb 1978)."""
    monkeypatch.setattr(diagnose, "SETS", {"fast": 100, "full": 120})
    model = ssm.Model("nile")

    @model.prior
    def prior():
        return {"level_variance": ssm.HalfFlat(), "noise_variance": ssm.HalfFlat()}

    @model.initial
    def initial():
        return {"x": ssm.Flat()}

    @model.transition
    def transition(x, level_variance):
        return {"x": ssm.Normal(x, variance=level_variance)}

    @model.observation
    def observation(x, noise_variance):
        return {"y": ssm.Normal(x, variance=noise_variance)}

    report = run(model, ssmppl.datasets.load("nile"), ["level break", "parameter break"])
    assert report.verdict == "effect"
    assert report.chosen == ["level break"]
    best = report.causes.iloc[0]
    assert "date = 28 (1898)" in best["form"]
    # With the level variance at zero: the difference of the two means.
    y = ssmppl.datasets.nile()
    assert best["estimate"] == pytest.approx(y[28:].mean() - y[:28].mean(), abs=0.5)
    assert report.closed["nats_per_sample"].iloc[0] > 0.0
