"""The programs in C++, line by line."""

import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest


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
        try:
            self.process.stdin.write(line + "\n")
        except BrokenPipeError:
            return ""
        text = self.process.stdout.readline()
        return text.rstrip("\n") if text.endswith("\n") else ""

    def decide(self, x: np.ndarray, part: str | None = None) -> list[str]:
        """The words of a decision: its id, action, reason, ...; no more than "" where the program
        is gone.
        """
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
    for i, (words, decision) in enumerate(zip(answers, decisions, strict=True)):
        assert words[1:3] == [str(decision.action), str(decision.reason)], i
        assert list(map(float, words[3:5])) == pytest.approx(
            [decision.lower, decision.upper], abs=accuracy
        ), i
        assert list(map(int, words[5:7])) == [decision.n_success, decision.n_failure], i
        z = (
            np.full(len(words) - 8, np.nan)
            if decision.embedding is None
            else np.ravel(decision.embedding)
        )
        np.testing.assert_allclose(list(map(float, words[7:-1])), z, rtol=1e-5, atol=accuracy)
        assert float(words[-1]) > 0.0
