"""The past of an engine, read from its store: its status, its decisions, and why they were made."""
