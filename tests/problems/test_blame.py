"""Which state a failure is blamed on: one that fails alone, and none where every state fails."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from ocp_torch.problems.blame import OTHERS, failing_state


@given(st.lists(st.booleans(), min_size=1, max_size=40))
def test_a_state_is_named_unless_all_fail(bad: list[bool]) -> None:
    x = torch.arange(len(bad), dtype=torch.float64)[:, None]

    def function(rows: torch.Tensor) -> None:
        if any(bad[int(i)] for i in rows[:, 0]):
            raise ValueError("no such state")

    state = failing_state(function, x)
    if not any(bad) or (all(bad) and len(bad) > 1):
        assert state is None
    elif state is None:  # as all that were asked fail as well
        assert sum(bad) > OTHERS
    else:
        assert bad[int(state)]
