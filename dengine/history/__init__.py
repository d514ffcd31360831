"""The past of an engine, read from its store: `status` (counts, error estimates, alarms, the list
of decisions), `explain` (why one decision was made), and `map` (where the parts lie in the
embedding).
"""
