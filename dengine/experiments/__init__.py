"""Replays of recorded streams, grids of them, their tables and pictures; live runs."""
