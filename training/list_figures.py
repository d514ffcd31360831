"""List every figure of the documentation with its source, and check those that a file holds.

    python training/list_figures.py             # how many figures each page has, and what is wrong
    python training/list_figures.py --all       # each figure with its source

A figure is a number with a unit or a percent sign, or a number in a cell of a table. It is checked
in one of three ways. `docs/results/index.md` is written again from its CSV files, so each of its
lines must be there. In a table of another page that has files, a number must be a value in one of
the rows that share a word with the first cell of its line; else it is wrong. In a sentence, a
number must be one of `settings`, which are read from the package, or of `totals`, which are
computed from the files. What is left is listed as "not checked". Exit code 1 if a checked figure is
wrong, or if fewer than two thirds of all figures are checked.
"""

import argparse
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from evidence import read_replays
from evidence_page import write_results

from dengine import Recipe
from dengine.experiments.metrics import Costs

DOCS = Path(__file__).resolve().parents[1] / "docs"
RESULTS = DOCS / "results"
EXPLANATION = DOCS / "explanation"
UNIT = (
    r"%|s|ms|min|minutes?|hours?|seconds?|MB|GB|kB|MiB|Hz|kHz|N|points?|parts|labels|replays|times|"
    r"retrains|cycles|streams|shuffles|kinds|faults"
)
NUMBER = r"(?<![\w.,/#-])\d[\d,]*(?:\.\d+)?"
FIGURE = re.compile(rf"({NUMBER})\s?({UNIT})(?!\w)")
CELL = re.compile(rf"{NUMBER}(?![\w.]|-[A-Za-z])")
LEAST_CHECKED = 2 / 3
UNCHECKED = "not checked"


@dataclass(frozen=True)
class Figure:
    """A number of a page, and where it comes from.

    Parameters
    ----------
    page, line : str, int
        Where it stands.
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
        **{f"{level} %": "a level of LB or alpha" for level in (5, 10, 80, 90, 95)},
    }


def totals() -> dict[str, dict[str, str]]:
    """Return figures that stand in sentences, by page: each with the file that it comes from."""
    soak = pd.read_csv(RESULTS / "soak_totals.csv").iloc[0]
    course = pd.read_csv(RESULTS / "soak.csv")
    full = course[course["cycle"] >= 36_000]
    rules = pd.read_csv(EXPLANATION / "rules_proof.csv")
    replays = read_replays(RESULTS / "replays.csv")
    # The variants of conv have ten shuffles.
    means = mean_replays(replays[replays["seed"] < 110]).set_index("recipe")
    bad = 100 * means["false_positive"] / means["accepted"]
    known = "conv, every stop known"
    planted = rules[rules["fault"] != ""]["broke"].dropna()
    megabytes = {name: full[f"{name}_bytes"] / 1e6 for name in ("server", "trainer")}
    source = "soak.csv"
    return {
        "README.md": {
            f"{means['certain'][known]:,.0f} parts": "replays.csv",
            f"{bad[known]:.1f} %": "replays.csv",
            f"{bad['conv']:.1f} %": "replays.csv",
        },
        "docs/explanation/speed.md": {
            f"{course['cycle'].max():,} parts": source,
            f"{soak['acknowledged']:,.0f} labels": "soak_totals.csv",
            f"{soak['retrains']:,.0f} retrains": "soak_totals.csv",
            f"{soak['retrain_worst_s']:.3f} s": "soak_totals.csv",
            f"{course['decide_worst_s'].max():.2f} s": source,
            f"{course['page_worst_s'].max():.2f} s": source,
            **{f"{values.max():.0f} MB": source for values in megabytes.values()},
        },
        "docs/explanation/proof.md": {
            **{f"{100 * broke:.0f} %": "rules_proof.csv" for broke in planted},
            "10,000 replays": "rules_proof.csv",
        },
    }


def mean_replays(replays: pd.DataFrame) -> pd.DataFrame:
    """Return the means of each method on insertion at (0.1, 90 %), as in the README."""
    settings = "set == 'insertion' and interval == 'wilson' and alpha == 0.1 and lower_bound == 0.9"
    columns = ["certain", "accepted", "false_positive"]
    return replays.query(settings).groupby("recipe", as_index=False)[columns].mean()


def sum_faults() -> pd.DataFrame:
    """Return the counts of faults by store and by what failed, as on the page about faults."""
    faults = pd.read_csv(EXPLANATION / "faults.csv")
    faults["fails"] = (
        faults["fault"].str.startswith("SIGKILL").map({True: "sigkill", False: "other"})
    )
    counts = {name: (name, "sum") for name in ("times", "labels", "lost", "wrong", "raised")}
    groups = faults.groupby(["store", "fails"], as_index=False)
    return groups.agg(kinds=("fault", "size"), **counts)


def number(text: str) -> float:
    """Return the value of a number with commas between thousands."""
    return float(text.replace(",", ""))


def decimals(text: str) -> int:
    """Return how many digits a number has behind its point."""
    return len(text.partition(".")[2])


def is_among(text: str, values: list[float]) -> bool:
    """Return whether a number, rounded as it is written, is a value or its hundredfold."""
    half = 0.5 * 10.0 ** -decimals(text) + 1e-9
    shown = number(text)
    return any(abs(shown - factor * value) <= half for value in values for factor in (1.0, 100.0))


def read_rows(tables: list[pd.DataFrame]) -> list[tuple[set[str], list[float]]]:
    """Return for each row of the tables the words of its texts, and its numbers with their counts.

    A share also stands for the number of replays that it is of.
    """
    rows = []
    for table in tables:
        numeric = table.select_dtypes("number").columns
        for _, row in table.iterrows():
            texts = " ".join(str(value) for name, value in row.items() if name not in numeric)
            values = [float(row[name]) for name in numeric if pd.notna(row[name])]
            if "broke" in numeric and pd.notna(row["broke"]) and "replays" in numeric:
                values.append(round(row["broke"] * row["replays"], 6))
            rows.append((words_of(texts), values))
    return rows


def words_of(text: str) -> set[str]:
    """Return the words of a text that tell one row from another."""
    return set(re.findall(r"[a-z0-9.]{3,}", text.lower()))


def generated_lines() -> set[str]:
    """Return the lines of the results' page, written anew from its files."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder, "guarantees.csv")
        copy.write_bytes((RESULTS / "guarantees.csv").read_bytes())
        write_results(read_replays(RESULTS / "replays.csv"), Path(folder))
        return set(Path(folder, "index.md").read_text("utf-8").splitlines())


def lines_of(page: Path) -> Iterator[tuple[int, str]]:
    """Yield number and text of each line outside code, but not the heads of tables."""
    is_code = False
    lines = page.read_text("utf-8").splitlines()
    for i, (line, following) in enumerate(zip(lines, [*lines[1:], ""], strict=True), 1):
        if line.startswith("```"):
            is_code = not is_code
        elif not is_code and not following.startswith("| ---"):
            yield i, line


def figures_of_results() -> Iterator[Figure]:
    """Yield the figures of the results' page."""
    expected = generated_lines()
    page = RESULTS / "index.md"
    for i, line in lines_of(page):
        found = CELL.findall(line.partition("|")[2]) if line.startswith("|") else []
        source = "written anew" if line in expected else "WRONG: the files give another line"
        for text in found or [" ".join(match) for match in FIGURE.findall(line)]:
            yield Figure("docs/results/index.md", i, text, source)


def figures_of_page(name: str, tables: list[pd.DataFrame]) -> Iterator[Figure]:
    """Yield the figures of another page, whose tables show rows of these."""
    rows = read_rows(tables)
    known = settings() | totals().get(name, {})
    for i, line in lines_of(DOCS.parent / name):
        if line.startswith("|"):
            yield from figures_of_row(name, i, line, rows)
            continue
        for match in FIGURE.finditer(line):
            text = " ".join(match.groups())
            yield Figure(name, i, text, known.get(text, UNCHECKED))


def figures_of_row(
    name: str, i: int, line: str, rows: list[tuple[set[str], list[float]]]
) -> Iterator[Figure]:
    """Yield the figures of a table's line, checked against the rows that its first cell names."""
    label, _, cells = line.strip("| ").partition("|")
    words = words_of(label)
    values = [value for texts, numbers in rows if words & texts for value in numbers]
    for text in CELL.findall(cells):
        source = UNCHECKED if not rows else "WRONG: no row has it"
        if is_among(text, values):
            source = "a row of its file"
        yield Figure(name, i, text, source)


PAGES: dict[str, Callable[[], Iterator[Figure]]] = {
    "README.md": lambda: figures_of_page(
        "README.md", [mean_replays(read_replays(RESULTS / "replays.csv"))]
    ),
    "docs/results/index.md": figures_of_results,
    "docs/explanation/proof.md": lambda: figures_of_page(
        "docs/explanation/proof.md",
        [
            pd.read_csv(EXPLANATION / f"{name}.csv")
            for name in ("proof", "proof_rocket", "rules_proof")
        ],
    ),
    "docs/explanation/faults.md": lambda: figures_of_page(
        "docs/explanation/faults.md", [sum_faults()]
    ),
    "docs/explanation/speed.md": lambda: figures_of_page("docs/explanation/speed.md", []),
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
