"""List every figure of the documentation with its source, and check those that a file holds.

    python training/list_figures.py             # how many figures each page has, and what is wrong
    python training/list_figures.py --all       # each figure with its source

A figure is a number with a unit or a percent sign, or a number in a cell of a table.

- `docs/results/index.md` is written again from its CSV files; each of its lines must be there.
- A table of another page that has files is computed again: its lines must have the same numbers in
  the same order. The table of `KEYED` alone joins rows of several streams: each of its numbers must
  stand in a row whose name begins with a word of the line.
- A sentence must have each of `totals`, which are computed from the files.

What is left is a setting of the package, or listed as "not checked". Exit code 1 if anything is
wrong, or if fewer than two thirds of all figures are checked.
"""

import argparse
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
from evidence import read_replays
from evidence_page import write_results

from dengine import Recipe
from dengine.experiments.metrics import Costs

DOCS = Path(__file__).resolve().parents[1] / "docs"
UNIT = (
    r"%|s|ms|min|minutes?|hours?|seconds?|MB|GB|kB|MiB|Hz|kHz|N|points?|parts|labels|replays|times|"
    r"retrains|cycles|streams|shuffles|kinds|faults"
)
NUMBER = r"(?<![\w.,/#-])\d[\d,]*(?:\.\d+)?"
FIGURE = re.compile(rf"({NUMBER})\s?({UNIT})(?!\w)")
CELL = re.compile(rf"{NUMBER}(?![\w.]|-[A-Za-z])")
LEAST_CHECKED = 2 / 3
UNCHECKED = "not checked"
RESULTS = "docs/results/index.md"
PROOF = "docs/explanation/proof.md"
KEYED = "| stream | `conv`: certain |"  # how the head of that table begins
Tables = Mapping[str, Sequence[Sequence[float]]]  # beginning of a head -> the numbers of each line


@dataclass(frozen=True)
class Figure:
    """A number of a page, and where it comes from.

    Parameters
    ----------
    page, line : str, int
        Where it stands; line 0 if it is missing.
    text : str
        The number with its unit.
    source : str
        What it was found in; "not checked"; or, for a figure that differs from its file, a text
        that begins with "WRONG".
    """

    page: str
    line: int
    text: str
    source: str


def read(name: str) -> pd.DataFrame:
    """Read a CSV file of the documentation."""
    return pd.read_csv(DOCS / name)


def mean_replays(n_shuffles: int) -> pd.DataFrame:
    """Return the means of each method on insertion at (0.1, 90 %), as in the README."""
    replays = read_replays(DOCS / "results/replays.csv")
    settings = "set == 'insertion' and interval == 'wilson' and alpha == 0.1 and lower_bound == 0.9"
    chosen = replays.query(settings).query(f"seed < {100 + n_shuffles}")
    return chosen.groupby("recipe")[["certain", "accepted", "false_positive"]].mean()


def tables_of_readme() -> Tables:
    """Return the numbers of the table of reducers."""
    means = mean_replays(30).loc[["conv", "rocket", "umap", "umap-learn", "pca"]]
    return {"| reducer |": means[["certain", "false_positive"]].to_numpy().tolist()}


def tables_of_faults() -> Tables:
    """Return the counts of the faults by store and by what failed."""
    faults = read("explanation/faults.csv")
    is_kill = faults["fault"].str.startswith("SIGKILL")
    groups = faults.groupby(["store", is_kill], sort=False)
    table = groups[["times", "labels", "lost", "wrong", "raised"]].sum()
    table.insert(0, "kinds", groups.size())
    return {"| store | what fails |": table.to_numpy().tolist()}


def tables_of_proof() -> Tables:
    """Return the numbers of the tables about rules, safe modes, histories and shuffles."""
    rules = read("explanation/rules_proof.csv")
    rules = rules[rules["fault"].isna()]
    endings = rules[rules["parts"] == 1500].set_index(["rule", "safe mode ends by", "stream"])
    endings = endings.sort_index()
    rules = rules[rules["parts"] == 600]
    columns = ["accepted", "a perfect bet", "broke", "account above 2"]

    def streams_of(rule: str, audited: Sequence[str]) -> list[list[float]]:
        of_rule = rules[rules["rule"] == rule].set_index("stream")
        known = of_rule[of_rule["outcomes"] == "all"]
        parts = of_rule[of_rule["outcomes"] == "audited, late, missing"].loc[known.index]
        both = pd.concat([known[columns[:3]], parts[list(audited)]], axis=1).to_numpy()
        return [[value for value in row if not np.isnan(value)] for row in both]

    ends = []
    for rule, ending in (
        ("local", "likelihood"), ("local", "bet"), ("local", "account"),
        ("cost", "account"), ("cost", "bet"), ("pooled", "bet"),
    ):  # fmt: skip
        of_ending = endings.loc[rule, ending]
        long = of_ending["parts of a safe mode"]
        more = of_ending["replays with more than 300"]["at the tolerance"]
        accepted = of_ending["accepted"]["doubling"]
        ends.append([long["constant, good"], long["at the tolerance"], more, accepted])
    engine = read("explanation/engine_proof.csv")
    engine["taken back"] = engine["corrected"] + engine["forgotten"]
    engine["opened again"] = engine["restarts"] + engine["killed"]
    shown = [
        "histories", "decisions", "accepted", "late reports", "taken back", "versions",
        "opened again", "comparisons", "faults",
    ]  # fmt: skip
    null = read("explanation/null_proof.csv")
    in_null = ["shuffles", "found", "moved", "labels", "certain of 1,000"]
    head = "| stream | all: accepted | best | broke | audited: accepted | best | broke |"
    return {
        f"{head}\n": streams_of("pooled", columns[:3]),
        f"{head} above two": streams_of("cost", columns),
        "| rule, and what ends safe mode |": ends,
        "| histories of |": engine[shown].to_numpy().tolist(),
        "| leak |": null[in_null].to_numpy().tolist(),
    }


@cache
def settings() -> dict[str, str]:
    """Return figures that are no measurements, each with the name under which it is set."""
    recipe = Recipe()
    costs = Costs()
    return {
        f"{recipe.budget:g} s": "Recipe.budget",
        f"{recipe.window:,} labels": "Recipe.window",
        f"{costs.check:g} s": "Costs.check",
        f"{costs.escape:g} s": "Costs.escape",
        f"{costs.false_reject:g} s": "Costs.false_reject",
        "500 Hz": "the bundled set",
        "1,503 parts": "the bundled set",
        "1,503 labels": "the bundled set",
    }


def totals_of_readme() -> dict[str, str]:
    """Return the figures of the README's sentences: each with the file that it comes from."""
    means = mean_replays(10)  # so many shuffles have the variants of conv
    bad = 100 * means["false_positive"] / means["accepted"]
    known = "conv, every stop known"
    texts = (f"{means['certain'][known]:,.0f} parts", f"{bad[known]:.1f} %", f"{bad['conv']:.1f} %")
    return dict.fromkeys(texts, "replays.csv")


def totals_of_proof() -> dict[str, str]:
    """Return the figures of sentences about the rules."""
    planted = read("explanation/rules_proof.csv").dropna(subset=["fault"])
    return {f"{100 * broke:.0f} %": "rules_proof.csv" for broke in planted["broke"]}


def totals_of_speed() -> dict[str, str]:
    """Return the figures of the paragraph about a long run."""
    totals = read("results/soak_totals.csv").iloc[0]
    course = read("results/soak.csv")
    full = course[course["cycle"] >= 36_000]
    texts = (
        f"{course['cycle'].max():,} parts",
        f"{totals['retrains']:,.0f} retrains",
        f"{totals['retrain_worst_s']:.3f} s",
        f"{course['decide_worst_s'].max():.2f} s",
        f"{course['page_worst_s'].max():.2f} s",
        f"{full['server_bytes'].max() / 1e6:.0f} MB",
        f"{full['trainer_bytes'].max() / 1e6:.0f} MB",
    )
    return dict.fromkeys(texts, "soak.csv, soak_totals.csv")


def is_shown_as(text: str, value: float) -> bool:
    """Return whether a number is a value, or a share in per cent, rounded as it is written."""
    half = 0.5 * 10.0 ** -len(text.partition(".")[2]) + 1e-9
    shown = float(text.replace(",", ""))
    return any(abs(shown - factor * value) <= half for factor in (1.0, 100.0))


def keyed_values() -> dict[str, list[float]]:
    """Return what the table of the pooled guarantee may show, by the first word of a stream."""
    values: dict[str, list[float]] = {}
    for name in ("proof", "proof_rocket"):
        table = read(f"explanation/{name}.csv").query("part == 'planted'")
        for _, row in table.iterrows():
            word = re.split(r"\W", row["configuration"])[0]
            n_broke = round(row["broke"] * row["replays"], 6)
            shown = [row["certain per 1503"], n_broke, row["replays"], row["alpha"], row["LB"]]
            values.setdefault(word, []).extend(shown)
    return values


def generated_lines() -> set[str]:
    """Return the lines of the results' page, written anew from its files."""
    results = DOCS / "results"
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "guarantees.csv")
        copy.write_bytes((results / "guarantees.csv").read_bytes())
        write_results(read_replays(results / "replays.csv"), Path(folder))
        return set(Path(folder, "index.md").read_text("utf-8").splitlines())


def lines_of(page: str) -> Iterator[tuple[int, str, str]]:
    """Yield number, text and, in a table, the head of each line outside code, but no heads."""
    is_code = False
    head = ""
    lines = (DOCS.parent / page).read_text("utf-8").splitlines()
    for i, (line, following) in enumerate(zip(lines, [*lines[1:], ""], strict=True), 1):
        if line.startswith("```"):
            is_code = not is_code
        elif following.startswith("| ---"):
            head = line + "\n"
        elif not is_code and not line.startswith("| ---"):
            head = head if line.startswith("|") else ""
            yield i, line, head


def figures_in(line: str) -> list[str]:
    """Return the figures of a line: numbers of a table's cells, or numbers with a unit."""
    if line.startswith("|"):
        return CELL.findall(line.strip("| ").partition("|")[2])
    return [" ".join(match) for match in FIGURE.findall(line)]


def figures_of_results() -> Iterator[Figure]:
    """Yield the figures of the results' page."""
    expected = generated_lines()
    for i, line, _ in lines_of(RESULTS):
        source = "written anew" if line in expected else "WRONG: the files give another line"
        for text in figures_in(line):
            yield Figure(RESULTS, i, text, source)


def figures_of_page(page: str, tables: Tables, totals: Mapping[str, str]) -> Iterator[Figure]:
    """Yield the figures of another page."""
    known = settings() | dict(totals)
    found = set[str]()
    keyed = keyed_values()
    left = {head: list(lines) for head, lines in tables.items()}
    for i, line, head in lines_of(page):
        lines = next((left[beginning] for beginning in left if head.startswith(beginning)), None)
        texts = figures_in(line)
        if lines is not None:
            values = lines.pop(0) if lines else []
            is_right = len(texts) == len(values) and all(map(is_shown_as, texts, values))
            source = "computed anew" if is_right else f"WRONG: the file gives {values}"
            sources = dict.fromkeys(texts, source)
        elif head.startswith(KEYED):
            words = re.findall(r"\w+", line.strip("| ").partition("|")[0])
            near = [value for word in words for value in keyed.get(word, [])]
            sources = {
                text: "a row of its stream"
                if any(is_shown_as(text, value) for value in near)
                else "WRONG: no row has it"
                for text in texts
            }
        else:
            sources = {text: known.get(text, UNCHECKED) for text in texts}
            found |= sources.keys()
        for text in texts:
            yield Figure(page, i, text, sources[text])
    for text in totals.keys() - found:
        yield Figure(page, 0, text, f"WRONG: {totals[text]} has it, the page has not")
    for head, lines in left.items():
        if lines:
            yield Figure(page, 0, head.strip(), f"WRONG: lines of the table are missing: {lines}")


PAGES: dict[str, Callable[[], Iterator[Figure]]] = {
    "README.md": lambda: figures_of_page("README.md", tables_of_readme(), totals_of_readme()),
    RESULTS: figures_of_results,
    PROOF: lambda: figures_of_page(PROOF, tables_of_proof(), totals_of_proof()),
    "docs/explanation/faults.md": lambda: figures_of_page(
        "docs/explanation/faults.md", tables_of_faults(), {}
    ),
    "docs/explanation/speed.md": lambda: figures_of_page(
        "docs/explanation/speed.md", {}, totals_of_speed()
    ),
}


def main() -> None:
    """Print the figures, how many are checked, and what is wrong."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--all", action="store_true", help="print each figure with its source")
    arguments = parser.parse_args()
    figures = [figure for page in PAGES.values() for figure in page()]
    wrong = [figure for figure in figures if figure.source.startswith("WRONG")]
    for figure in figures if arguments.all else wrong:
        print(f"{figure.page}:{figure.line}: {figure.text}: {figure.source}")
    for page in PAGES:
        of_page = [figure for figure in figures if figure.page == page]
        n_checked = sum(figure.source != UNCHECKED for figure in of_page)
        print(f"{page:28} {len(of_page):4} figures, {n_checked:4} checked")
    n_checked = sum(figure.source != UNCHECKED for figure in figures) - len(wrong)
    print(f"{len(figures)} figures, {n_checked} checked and right, {len(wrong)} wrong")
    sys.exit(int(bool(wrong) or n_checked < LEAST_CHECKED * len(figures)))


if __name__ == "__main__":
    main()
