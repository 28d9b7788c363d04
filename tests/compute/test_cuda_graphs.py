"""CudaGraphs of functions; where there is no GPU, of functions that are run again."""

import math

import pytest
import torch

from ocp_torch.compute import cuda_graphs as replays
from ocp_torch.compute.cuda_graphs import CudaGraphs, CudaRecorder
from ocp_torch.compute.decisions import decided
from support.rerun import Rerun
from support.waiting import Waits


def recorder(device):
    return CudaRecorder() if device.type == "cuda" else Rerun()


def test_from_the_third_call_on_it_is_replayed_into_the_same_tensors(device):
    replay = CudaGraphs(recorder(device))
    found = [
        replay("square", lambda x, _: [x * x, None], [torch.full((3,), float(k), device=device), None])
        for k in range(6)
    ]
    assert [float(f[0][0]) for f in found[:2]] == [0.0, 1.0]
    assert all(f[0] is found[2][0] for f in found[3:])
    assert float(found[2][0][0]) == 25.0
    assert found[5][1] is None


def test_captures_are_of_one_function_and_one_form_of_inputs():
    counted = Rerun()
    replay = CudaGraphs(counted)
    for _ in range(5):
        assert float(replay("a", lambda x: [x.sum()], [torch.ones(2)])[0]) == 2.0
        assert float(replay("a", lambda x: [x.sum()], [torch.ones(3)])[0]) == 3.0
        assert float(replay("b", lambda x: [x.prod()], [torch.ones(3)])[0]) == 1.0
    assert counted.captures == 3
    replay.forget()
    replay("a", lambda x: [x.sum()], [torch.ones(2)])
    assert counted.captures == 3


def test_what_is_expanded_is_placed_once(device):
    replay = CudaGraphs(recorder(device))
    column = lambda k: torch.full((1, 2), float(k), device=device).expand(5, 2)
    for k in range(5):
        assert float(replay("sum", lambda x: [x.sum()], [column(k)])[0]) == 10.0 * k


def test_a_course_that_changes_is_taken_as_it_is(device):
    """Also where the first answers were others, and where they change again and again."""
    replay = CudaGraphs(recorder(device))
    function = lambda x: [x + 1.0 if decided((x > 0).all()) else x - 1.0]
    for sign in (1, 1, 1, 1, -1, 1, -1, -1, -1, -1, 1, 1, -1, 1, -1, 1, -1):
        assert float(replay("sign", function, [torch.full((2,), float(sign), device=device)])[0][0]) == 2.0 * sign


def test_constants_are_made_once(device):
    """Of Python's numbers, or brought from the host; and whoever is given one may change it."""
    host = torch.tensor([5.0, 7.0])

    def function(x):
        twice = x.new_tensor([1.0, 2.0])
        twice *= 2.0
        return [x * twice + torch.tensor(3.0, device=x.device) + host.to(x) + torch.as_tensor(x)]

    replay = CudaGraphs(recorder(device))
    at = lambda k: torch.full((2,), float(k), device=device)
    for k in range(4):
        assert torch.equal(replay("linear", function, [at(k)])[0].cpu(), torch.tensor([8.0 + 3.0 * k, 10.0 + 5.0 * k]))
    with Waits() as waits:
        replay("linear", function, [at(4)])
    assert waits.seen == set()


def test_outside_of_replays_a_question_is_answered_at_once():
    assert decided(torch.tensor(7)) == 7
    assert decided(torch.tensor(True)) == 1


def test_what_cannot_be_captured_is_called(caplog):
    class Unable(Rerun):
        def capture(self, function):
            raise RuntimeError("operation not permitted when stream is capturing")

    replay = CudaGraphs(Unable())
    with caplog.at_level("DEBUG", logger=replays.__name__):
        for k in range(6):
            assert float(replay("square", lambda x: [x * x], [torch.tensor(float(k))])[0]) == k * k
    assert caplog.text.count("is not replayed") == 1


@pytest.mark.parametrize(
    "function", [lambda x: [x + torch.rand(())], lambda x: [x + next(NUMBERS)]], ids=["torch", "python"]
)
def test_what_draws_random_numbers_is_called(function):
    """A replay would draw the same again; here it is seen as it differs from a call."""
    counted = Rerun()
    replay = CudaGraphs(counted)
    found = {float(replay("noisy", function, [torch.zeros(())])[0]) for _ in range(12)}
    assert len(found) == 12
    assert counted.captures == 1


NUMBERS = iter(range(1000))


def test_an_impure_function_runs_once_a_call(device):
    replay, total = CudaGraphs(recorder(device)), torch.zeros((), device=device)

    def add(x):
        total.add_(x)
        return []

    for k in range(6):
        replay("add", add, [torch.full((), float(k), device=device)], pure=False)
    assert float(total) == 15.0


def test_what_changes_later_for_another_reason_is_noticed_and_said(monkeypatch, caplog):
    """A problem whose parameters somebody sets, or a loss that reads a clock."""
    monkeypatch.setattr(replays, "CHECK_EVERY", 5)
    replay, factor = CudaGraphs(Rerun()), [2.0]
    scaled = lambda x: [x * torch.tensor(factor[0])]
    once = lambda: float(replay("scaled", scaled, [torch.ones(())])[0])
    assert [once() for _ in range(6)] == [2.0] * 6
    factor[0] = 3.0  # a replay gives the constant of before
    found = [once() for _ in range(8)]
    assert found == sorted(found)
    assert found[0] == 2.0
    assert found[-2:] == [3.0, 3.0]
    assert caplog.text.count("gives something else for the same states") == 1


@pytest.mark.parametrize(
    ("left", "right", "same"),
    [
        ([1.0, 2.0], [1.0, 2.0 + 1e-6], True),
        ([1.0, 2.0], [1.0, 2.001], False),
        ([0.0, 1e6], [1.0, 1e6], True),  # rounding of the largest
        ([math.nan, 1.0], [2.0, 1.0], False),
        ([2.0, 1.0], [math.nan, 1.0], False),
        ([math.inf, 1.0], [-math.inf, 1.0], False),
        ([math.nan, math.inf], [math.nan, math.inf], True),
        ([], [], True),
    ],
)
def test_a_replay_is_a_call_but_for_rounding(left, right, same):
    assert replays._alike([None, torch.tensor(left)], [None, torch.tensor(right)]) is same
