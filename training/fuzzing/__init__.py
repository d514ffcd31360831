"""Malformed requests by the kind, for `training/fuzz_requests.py`."""
