"""What `training/prove.py` measures, a part a module; `tests/statistical` runs the same functions, small."""
