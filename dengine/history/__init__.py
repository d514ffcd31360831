"""What a store tells of the past: how the cell is doing, what was decided, and why."""
