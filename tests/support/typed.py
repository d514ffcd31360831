"""One Python command of a page, in a process that has its heavy imports behind it; `test_docs.py`
gives the globals.

WHERE : the folder that it is typed in.  ARGV : the words after `python`, or those of `dengine …`.
SAID : the file for what it prints.
"""

import os
import runpy
import sys
from pathlib import Path

from joblib.externals.loky import get_reusable_executor

os.chdir(WHERE)  # noqa: F821  # a global that `run_path` sets
screen = os.open(SAID, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)  # noqa: F821
for stream in (1, 2):
    os.dup2(screen, stream)
sys.argv = ARGV  # noqa: F821
try:
    if sys.argv[0] in ("dengine", "-m"):
        module = sys.argv[0] if sys.argv[0] == "dengine" else sys.argv.pop(1)
        sys.path.insert(0, str(Path.cwd()))
        runpy.run_module(module, run_name="__main__")
    else:
        sys.path.insert(0, str(Path(sys.argv[0]).resolve().parent))
        runpy.run_path(sys.argv[0], run_name="__main__")
finally:
    # A forked process waits for joblib's idle workers at its end, one that was started by itself
    # sends them home.
    get_reusable_executor(reuse=True).shutdown(wait=True, kill_workers=True)
