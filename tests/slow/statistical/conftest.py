"""These tests run the functions of the long proof, `training/proof`, small."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "training"))
