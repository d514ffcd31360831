"""The programs in C++, line by line."""

import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np


class Program:
    """One that runs: dengine-cell with these arguments, or another."""

    def __init__(
        self, programs: Path, *arguments: Any, name: str = "dengine-cell", **options: Any
    ) -> None:
        command = [str(programs / name), *map(str, arguments)]
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        self.process = subprocess.Popen(command, text=True, bufsize=1, **pipes, **options)

    def __enter__(self) -> "Program":
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()

    def ask(self, line: str) -> str:
        """The answer to a line; "" where the program is gone."""
        self.process.stdin.write(line + "\n")
        return self.process.stdout.readline().rstrip("\n")

    def decide(self, x: np.ndarray, part: str | None = None) -> list[str]:
        """The words of a decision: its id, action, reason, ..."""
        return self.ask(asked(x, part)).split(",")

    def end(self) -> tuple[int, str]:
        """Its exit code and what it said on stderr."""
        _, text = self.process.communicate(timeout=60)
        return self.process.returncode, text

    def must_refuse(self, why: str) -> None:
        """It ended by itself and said why; nothing was decided."""
        out, text = self.process.communicate(timeout=60)
        assert (self.process.returncode, out) == (1, "")
        assert why in text


def asked(x: np.ndarray, part: str | None = None) -> str:
    return f"decide {part + ' ' if part else ''}{','.join(f'{v:.9g}' for v in x.ravel())}"


def must_agree(answers: Iterable[list[str]], decisions: list[Any], accuracy: float = 1e-6) -> None:
    """Assert that answers are these decisions, embeddings where they are told, and say how long
    they took.
    """
    for words, decision in zip(answers, decisions, strict=True):
        assert words[1:3] == [decision.action, decision.reason]
        assert words[5:7] == [str(decision.n_success), str(decision.n_failure)]
        bounds, z = [decision.lower, decision.upper], decision.embedding
        z = [np.nan] * (len(words) - 8) if z is None else np.ravel(z)
        numbers = np.array([*words[3:5], *words[7:-1]], dtype=float)
        np.testing.assert_allclose(numbers, [*bounds, *z], rtol=1e-5, atol=accuracy)
        assert float(words[-1]) > 0.0
