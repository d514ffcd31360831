"""Replays of recorded streams, with grids, baselines, costs, tables and figures.

The command line and the scripts in `training/` use them; an engine in a cell does not.
"""
