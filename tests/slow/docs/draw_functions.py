"""Print random functions and modules of the package as a caller sees them, without their bodies.

    python -m tests.slow.docs.draw_functions --seed 1 --functions 40 --modules 20

A reader who has not seen the code says what each function does and returns, and what each module
holds. Comparing the answers with the code shows which names and docstrings are not clear.
"""

import argparse
import ast
import random
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[3] / "dengine"
Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class DrawnFunction:
    """A function and where it is: path of its module, name of its class or "" outside one."""

    path: Path
    class_name: str
    node: Function

    def __str__(self) -> str:
        """Return its place, decorators, signature and docstring."""
        decorators = "".join(f"@{ast.unparse(node)}\n" for node in self.node.decorator_list)
        keyword = "async def" if isinstance(self.node, ast.AsyncFunctionDef) else "def"
        returns = f" -> {ast.unparse(self.node.returns)}" if self.node.returns else ""
        signature = f"{keyword} {self.node.name}({ast.unparse(self.node.args)}){returns}"
        docstring = ast.get_docstring(self.node) or "(no docstring)"
        where = f"{self.path}, class {self.class_name}" if self.class_name else str(self.path)
        return f"{where}\n{decorators}{signature}\n{docstring}"


def functions_in(path: Path, body: list[ast.stmt], class_name: str = "") -> Iterator[DrawnFunction]:
    """Yield functions and methods whose body has four lines or more, without special methods."""
    for node in body:
        if isinstance(node, ast.ClassDef):
            yield from functions_in(path, node.body, f"{class_name}.{node.name}".lstrip("."))
        elif isinstance(node, Function) and not node.name.startswith("__"):
            statements = node.body[1:] if ast.get_docstring(node) is not None else node.body
            if statements and statements[-1].end_lineno - statements[0].lineno >= 3:
                yield DrawnFunction(path, class_name, node)


def main() -> None:
    """Parse, draw, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--functions", type=int, default=40)
    parser.add_argument("--modules", type=int, default=20)
    options = parser.parse_args()
    paths = sorted(PACKAGE.rglob("*.py"))
    modules = {
        path.relative_to(PACKAGE.parent): ast.parse(path.read_text("utf-8")) for path in paths
    }
    functions = [
        function for path, module in modules.items() for function in functions_in(path, module.body)
    ]
    generator = random.Random(options.seed)
    print(f"{len(functions)} functions in {len(modules)} modules; seed {options.seed}")
    for number, function in enumerate(generator.sample(functions, options.functions), 1):
        print(f"\n[{number}] {function}")
    for number, path in enumerate(generator.sample(list(modules), options.modules), 1):
        first_paragraph = (ast.get_docstring(modules[path]) or "(no docstring)").split("\n\n")[0]
        print(f"\n[module {number}] {path}\n{first_paragraph}")


if __name__ == "__main__":
    main()
