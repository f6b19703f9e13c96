"""Functions of ArviZ on the results of `sample`: a few by default, all in the slow stage."""

import csv

import arviz as az
import matplotlib
import pytest

from bench import arviz_functions as bench

FEW = ("ess", "rhat", "mcse", "hdi", "loo", "compare", "summary", "from_netcdf", "plot_khat")


@pytest.fixture(scope="module")
def results():
    matplotlib.use("Agg")
    return bench.sampled(("Gibbs", "MetropolisHastings"))


@pytest.mark.parametrize("name", FEW)
def test_numbers_are_those_by_hand(name, results):
    for result in results.values():
        assert bench.outcome(name, bench.calls()[name], result) == ("right", "")


def test_a_wrong_number_is_found(results):
    """Of the checks themselves, each with the answer of another result or function."""
    result, other = results.values()
    for name in ("ess", "rhat", "mcse", "hdi", "loo"):
        function, check = bench.calls()[name]
        assert not check(function(az, other), result) or name == "loo"
    _, check = bench.calls()["ess"]
    assert not check(az.ess(result.idata, method="tail"), result)


def test_energies_are_refused_not_made_up(results):
    for name in ("bfmi", "plot_energy"):
        for result in results.values():
            assert bench.outcome(name, bench.calls()[name], result)[0] == "refused"


def test_the_table_has_every_function_and_method():
    with bench.TABLE.open(newline="", encoding="utf-8") as file:
        rows = [r for r in csv.DictReader(file) if r["ArviZ"] == az.__version__]
    if not rows:
        pytest.skip(f"no outcomes of ArviZ {az.__version__} are kept")
    assert {r["function"] for r in rows} == set(bench.calls())
    assert {r["method"] for r in rows} == set(bench.METHODS)
    wrong = {r["function"] for r in rows if r["outcome"] == "wrong"}
    assert wrong <= bench.HAS_TO_BE_REFUSED  # said in the docs


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_the_whole_table():
    found = bench.rows([])
    wrong = {name for _, name, _, outcome, _ in found if outcome == "wrong"}
    assert wrong <= bench.HAS_TO_BE_REFUSED
    with bench.TABLE.open(newline="", encoding="utf-8") as file:
        kept = {tuple(r[:4]) for r in csv.reader(file)}
    if any(r[0] == az.__version__ for r in kept):
        assert {tuple(r[:4]) for r in found} <= kept
