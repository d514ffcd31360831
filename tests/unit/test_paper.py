"""The paper's tables and findings, from frames made by hand."""

from itertools import product

import pandas as pd

from dengine.experiments.grid import PAPER_GRID
from training.paper import LOWER_BOUNDS, PUBLISHED, findings, paper_table

ALPHAS = PAPER_GRID["alphas"]


def frame(interval: str = "wilson", recipe: str = "conv", **cells) -> pd.DataFrame:
    """Two replays a cell: those of the paper, one a little above and one below; or what `cells`
    says of all.
    """
    rows = []
    for alpha, bound, sign in product(ALPHAS, LOWER_BOUNDS, (-1, 1)):
        false_positive, certain = PUBLISHED[interval, alpha, bound]
        row = {"recipe": recipe, "interval": interval, "alpha": alpha, "lower_bound": bound}
        row |= {"guarantee": "local", "stops": "some", "confirm": False}
        row |= {"certain": certain + sign, "false_positive": false_positive + sign}
        rows.append(row | {"first_certain": 10.0 / alpha} | cells)
    return pd.DataFrame(rows)


def by_claim(found: list[str], claim: str) -> list[bool]:
    return [line.startswith("confirmed: ") for line in found if claim in line]


def test_a_table_has_the_papers_form_with_ours_and_theirs():
    some = frame().query("alpha == 0.1 or lower_bound == 0.8")
    table = paper_table(some, "conv", "wilson")  # two cells were not played
    assert table.startswith("| alpha / LB | 80 % | 90 % | 95 % |\n")
    assert "| 0.05 | 39.6 ± 1.4 / 1151.4 ± 1.4 [39.6 / 1151.4] | - | - |" in table


def test_the_papers_own_figures_bear_its_findings_out():
    lines = findings(pd.concat([frame(), frame("binomial")]))
    claims = {"Wilson interval reacts": 1, "binomial interval does not react": 1}
    claims |= {"share of false positives": 2, "delays the first": 3}
    for claim, n in claims.items():
        assert by_claim(lines, claim) == [True] * n


def test_a_finding_that_does_not_hold_says_so():
    missed = frame(certain=900), frame("binomial", certain=500, false_positive=60)
    lines = findings(pd.concat(missed))
    assert by_claim(lines, "Wilson interval reacts") == [False]
    assert by_claim(lines, "share of false positives") == [True, False]
    assert by_claim(findings(frame(first_certain=50.0)), "delays the first") == [False] * 3
