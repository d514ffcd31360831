"""Play what the tables of the documentation come from, with one commit.

    python training/make_evidence.py --list
    python training/make_evidence.py --screw screw_driving.npz
    python training/make_evidence.py --only "rules;guarantees"
    python training/make_evidence.py --publish      # copy what is finished into docs/
    python training/make_evidence.py --continue     # play what is not published, at its commit

The commit is checked out into OUT/source, so that the working tree may change meanwhile, and each
part is a command in that folder. OUT/manifest.json has for each finished part the commit, the
command, the machine, when it ended, its hours, and the SHA-256 of its inputs and of each file that
goes into the documentation. A part that was interrupted continues with the next call, since its
command keeps what is finished. A finished part is not played again. A run of another commit needs
another OUT; without --commit it is the one of the manifest, or the last one. With --continue the
published parts count as finished, so that several machines, or days, can share the work.

`screw driving` is a file that `make_screw_driving.py` writes. The part "faults" needs a PostgreSQL
server, whose address stands in DENGINE_TEST_POSTGRES (see .ci/postgres.sh).
"""

import argparse
import hashlib
import json
import os
import platform
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

REPO = Path(__file__).resolve().parents[1]
MANIFEST = Path("docs/results/manifest.json")
POSTGRES = "DENGINE_TEST_POSTGRES"
INSERTION = "dengine/data/insertion.npz"


@dataclass(frozen=True)
class Part:
    """A command, and what it writes.

    Parameters
    ----------
    command : str
        Words behind `python`. {out} is the part's folder, {screw} the option for the file of screw
        driving, if it is given, and {jobs} the number of processes.
    files : dict of str to str
        The files that it writes into {out}, each with its place in the repository.
    folder : str
        Parts that continue each other's files share a folder.
    """

    command: str
    files: dict[str, str]
    folder: str = ""


def results(*names: str) -> dict[str, str]:
    """Return where files of the results' page lie in OUT and in the repository."""
    return {f"evidence/{name}": f"docs/results/{name}" for name in names}


PLAY = "{screw} --keep {out}/kept --out {out} --n-jobs {jobs} --seeds"
REPLAYS = f"training/evidence.py{PLAY}"
FAST = "--only conv,rocket,umap,pca,knn,wskde,promises"
GUARANTEES = f"training/evidence_guarantees.py{PLAY}"
TABLE = results("guarantees.csv")
PAGE = results("index.md", "replays.csv", "differences.csv", "curves.png", "net_seconds.png")
PROOF = "-m tests.slow.proof --jobs {jobs} --docs {out} --out {out}/kept"
# In the order in which they are played. Each is to end within two hours on two idle cores.
PARTS = {
    "rules": Part(
        "-m tests.slow.proof.rules --jobs {jobs} --docs {out} --out {out}/kept",
        {"rules_proof.csv": "docs/explanation/rules_proof.csv"},
    ),
    "engine": Part(
        "-m tests.slow.proof.engine --jobs {jobs} --docs {out} --out {out}/kept",
        {"engine_proof.csv": "docs/explanation/engine_proof.csv"},
    ),
    "null": Part(
        "-m tests.slow.proof.null --jobs {jobs} --docs {out} --out {out}/kept",
        {"null_proof.csv": "docs/explanation/null_proof.csv"},
    ),
    "guarantees 1 to 3": Part(f"{GUARANTEES} 100:103", TABLE, "replays"),
    "guarantees 4 to 6": Part(f"{GUARANTEES} 103:106", TABLE, "replays"),
    "guarantees 7 to 10": Part(f"{GUARANTEES} 106:110", TABLE, "replays"),
    # The slow methods, which are not among the `FAST`, have three shuffles.
    "replays 1 to 3": Part(f"{REPLAYS} 100:103", PAGE, "replays"),
    "replays 4 to 6": Part(f"{REPLAYS} 103:106 {FAST}", PAGE, "replays"),
    "replays 7 and 8": Part(f"{REPLAYS} 106:108 {FAST}", PAGE, "replays"),
    "replays 9 and 10": Part(f"{REPLAYS} 108:110 {FAST}", PAGE, "replays"),
    "costs": Part("training/benchmark_costs.py --n-jobs {jobs} --out {out}", {}),
    "proof, rocket": Part(
        f"{PROOF} --reducer rocket --only null,planted,cost,noise --repeats 60",
        {"proof.csv": "docs/explanation/proof_rocket.csv"},
    ),
    # The last of these writes the rows of all.
    "proof, 10 replays": Part(f"{PROOF} --repeats 10", {}, "proof"),
    "proof, 25 replays": Part(f"{PROOF} --repeats 25", {}, "proof"),
    "proof, 40 replays": Part(
        f"{PROOF} --repeats 40", {"proof.csv": "docs/explanation/proof.csv"}, "proof"
    ),
    "faults": Part(
        "-m tests.slow.faults --trials 1 --kills 100 --others 20 --ids 1000000"
        " --postgres {postgres} --out {out}/faults.csv",
        {"faults.csv": "docs/explanation/faults.csv"},
    ),
    "speed": Part("training/benchmark_cycle.py --replays 30 --out {out}", {}),
    "reading": Part("training/benchmark_reading.py --folder {out}", {}),
    "soak": Part(
        "training/soak.py --out {out}",
        {"soak.csv": "docs/results/soak.csv", "soak_totals.csv": "docs/results/soak_totals.csv"},
    ),
}


def git(*arguments: str) -> str:
    """Run git in the repository; return what it printed. Raises SystemExit if it fails."""
    command = ["git", "-C", str(REPO), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"git {' '.join(arguments)} failed: {done.stderr.strip()}")
    return done.stdout.strip()


def digest(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def describe_machine() -> str:
    """Return what a time depends on: processor, number of cores, Python and torch."""
    import torch

    cpu_info = Path("/proc/cpuinfo")
    lines = cpu_info.read_text("utf-8").splitlines() if cpu_info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    processor = names[0] if names else platform.machine()
    python = f"Python {platform.python_version()}, torch {torch.__version__}"
    return f"{processor}, {os.cpu_count()} cores; {platform.system()}, {python}"


class Run:
    """The parts of one commit in one folder, and their manifest.

    Parameters
    ----------
    out : Path
        Folder of everything that is played.
    commit : str or None
        What is played, as git names it. None: what `out` has parts of, or the last commit.

    Raises
    ------
    SystemExit
        If git knows no such commit, or `out` has parts of another one.
    """

    def __init__(self, out: Path, commit: str | None) -> None:
        self.out = out.resolve()
        self.source = self.out / "source"
        self.path = self.out / "manifest.json"
        self.manifest: dict[str, Any] = {}
        if self.path.exists():
            self.manifest = json.loads(self.path.read_text("utf-8"))
        theirs = self.manifest.get("checkout")
        checkout = git("rev-parse", "--short=8", commit or theirs or "HEAD")
        if theirs not in (None, checkout):
            raise SystemExit(
                f"{out} has parts of commit {theirs}, not of {checkout}; leave out --commit, or "
                "give another --out."
            )
        # As the tables name it: the last commit until then that changed dengine.
        changed = git("log", "-1", "--format=%h", "--abbrev=8", checkout, "--", "dengine")
        self.about = {"commit": changed, "checkout": checkout}
        self.manifest = self.about | {"parts": self.manifest.get("parts", {})}

    def is_finished(self, name: str) -> bool:
        """Return whether a part was played to its end."""
        return "finished" in self.manifest["parts"].get(name, {})

    def folder(self, name: str) -> Path:
        """Return the folder of a part's files."""
        return self.out / (PARTS[name].folder or name).replace(", ", "_").replace(" ", "_")

    def play(self, name: str, screw: Path | None, jobs: int) -> None:
        """Play a part, from where it was interrupted, and note it in the manifest.

        The commit is checked out first, as a git worktree, unless it is there. Raises SystemExit
        if the command fails, or is stopped, and FileNotFoundError if it did not write one of its
        `files`. The hours until then are noted.
        """
        if not self.source.exists():
            git("worktree", "prune")
            git("worktree", "add", "--detach", str(self.source), self.about["checkout"])
        part = PARTS[name]
        self.folder(name).mkdir(parents=True, exist_ok=True)
        words = part.command.format(
            out=self.folder(name),
            screw=f" --screw {screw.resolve()}" if screw else "",
            jobs=jobs,
            postgres=os.environ.get(POSTGRES, ""),
        ).split()
        threads = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
        environment = os.environ | threads | {"PYTHONPATH": str(self.source)}
        entry = self.manifest["parts"].setdefault(name, {"hours": 0.0})
        began = time.monotonic()
        try:
            subprocess.run([sys.executable, *words], cwd=self.source, env=environment, check=True)
            finished = datetime.now(UTC)
        except subprocess.CalledProcessError as error:
            raise SystemExit(f"The part {name!r} failed; its error is above.") from error
        finally:
            entry["hours"] = round(entry["hours"] + (time.monotonic() - began) / 3600, 3)
            self._write()
        inputs = {"insertion": self.source / INSERTION}
        if screw and "{screw}" in part.command:
            inputs["screw driving"] = screw
        entry |= {
            "finished": f"{finished:%Y-%m-%d %H:%M}",
            "command": part.command,
            "jobs": jobs,
            "machine": describe_machine(),
            "inputs": {key: digest(path) for key, path in inputs.items()},
            "files": {
                place: digest(self.folder(name) / file) for file, place in part.files.items()
            },
        }
        self._write()

    def take_over(self, published: dict[str, Any]) -> None:
        """Let the parts of `published`, a manifest as `publish` writes it, count as finished.

        Their files are copied from the repository into the folders of the parts, where later parts
        continue them, and the manifest is written. Nothing happens if the manifest here has any
        part, begun here or taken over before. Raises KeyError for a part that is not in `PARTS`,
        and FileNotFoundError for a file that is missing in the repository.
        """
        if self.manifest["parts"]:
            return
        for name in published["parts"]:
            for file, place in PARTS[name].files.items():
                (self.folder(name) / file).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(REPO / place, self.folder(name) / file)
        self.manifest["parts"] = published["parts"]
        self._write()

    def publish(self) -> None:
        """Copy the files of all finished parts, and the manifest, into the documentation."""
        published: dict[str, Any] = self.about | {"parts": {}}
        for name in filter(self.is_finished, PARTS):
            entry = self.manifest["parts"][name]
            for file, place in PARTS[name].files.items():
                shutil.copy(self.folder(name) / file, REPO / place)
                entry["files"][place] = digest(REPO / place)  # later parts may write it again
            published["parts"][name] = entry
        write_json(REPO / MANIFEST, published)

    def _write(self) -> None:
        write_json(self.path, self.manifest)


def write_json(path: Path, value: object) -> None:
    """Write a JSON file, replacing what was there."""
    path.write_text(json.dumps(value, indent=1) + "\n", encoding="utf-8")


def stop(number: int, frame: object) -> None:
    """End the program when it is told to, so that the hours so far are noted."""
    raise SystemExit(f"Stopped by signal {number}; the same command continues.")


def main() -> None:
    """Play the parts that are asked for and not finished, or publish the finished ones."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/all_evidence"))
    parser.add_argument("--commit", help="what is played, if OUT has no parts yet")
    parser.add_argument("--screw", type=Path, help="the screw-driving set, an .npz file")
    parser.add_argument(
        "--only", default=";".join(PARTS), help="names of parts, with semicolons between"
    )
    parser.add_argument("--jobs", type=int, default=2, help="processes at a time")
    parser.add_argument("--list", action="store_true", help="print the parts; play nothing")
    parser.add_argument(
        "--continue", dest="goes_on", action="store_true", help="play what is not published yet"
    )
    parser.add_argument("--publish", action="store_true", help="copy finished parts into docs/")
    arguments = parser.parse_args()
    names = [name.strip() for name in arguments.only.split(";")]
    if unknown := [name for name in names if name not in PARTS]:
        parser.error(f"expected parts of {'; '.join(PARTS)}, got {'; '.join(unknown)}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    published = json.loads((REPO / MANIFEST).read_text("utf-8")) if arguments.goes_on else {}
    run = Run(arguments.out, published.get("checkout", arguments.commit))
    if published:
        run.take_over(published)
    signal.signal(signal.SIGTERM, stop)
    if arguments.publish:
        run.publish()
    elif not arguments.list:
        for name in names:
            if "{postgres}" in PARTS[name].command and not os.environ.get(POSTGRES):
                print(f"{name}: left out, since {POSTGRES} names no server.", flush=True)
            elif not run.is_finished(name):
                print(f"{datetime.now(UTC):%H:%M} {name}", flush=True)
                run.play(name, arguments.screw, arguments.jobs)
    for name in PARTS:
        entry = run.manifest["parts"].get(name, {})
        state = f"finished {entry['finished']}" if run.is_finished(name) else "to do"
        print(f"{name:20} {state:28} {entry.get('hours', 0):6.2f} h")


if __name__ == "__main__":
    main()
