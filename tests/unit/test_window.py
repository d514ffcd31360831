"""The window of the newest labelled traces: what was handed out stays as it was, whatever comes in
afterwards.
"""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dengine.engine.trainer import TrainingWindow


@settings(deadline=None)
@given(capacity=st.integers(1, 200), steps=st.lists(st.integers(0, 90), max_size=6))
def test_every_snapshot_is_of_the_newest_then_and_never_changes(capacity, steps):
    window, handed_out, last = TrainingWindow(capacity), [], 0
    for n in steps:
        if n % 7 == 1:
            window.refill(window.snapshot())
        for seq in range(last + 1, last + n + 1):
            window.add(np.full((1, 3), float(seq), np.float32), seq % 2, 100 + seq, seq)
        last += n
        handed_out.append((window.snapshot(), list(range(max(0, last - capacity) + 1, last + 1))))
    for snapshot, expected in handed_out:
        assert snapshot.seq.tolist() == snapshot.traces[:, 0, 0].tolist() == expected
        assert snapshot.labels.tolist() == [seq % 2 for seq in expected]
        assert snapshot.hashes.tolist() == [100 + seq for seq in expected]
