"""Replays of recorded streams, with grids, baselines, costs, tables and figures.

The command line and the scripts in `training/` use the modules of this folder; an engine in a cell
does not. This file itself holds no code.
"""
