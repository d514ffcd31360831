"""Decide, report, retrain, run: one engine, its versions, and what it does between two cycles."""
