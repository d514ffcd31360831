"""Faults that are injected into a cell on purpose, and what becomes of its labels, decisions and waits."""
