"""Malformed inputs and requests by the kind, for `training/fuzz_inputs.py` and `training/fuzz_requests.py`."""
