"""What `training/prove.py` measures, a part a module; `tests/slow/statistical` runs the same functions, small."""
