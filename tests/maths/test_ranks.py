"""One process is its own mean; several agree, fail and part as they should, by the files each leaves."""

import os

import pytest
import torch
import torch.distributed as dist

from ocp_torch.errors import InputError, ProblemError
from ocp_torch.maths.ranks import Alone, Left, LostError, joined


def test_a_process_alone_gives_back_what_it_is_given():
    alone, tensors = joined(), [torch.ones(2), torch.zeros(())]
    assert type(alone) is Alone
    assert all(mean is given for mean, given in zip(alone.mean(tensors), tensors, strict=True))
    assert alone.agree([True, False]) == [True, False]
    assert alone.from_first(lambda: 3) == alone.alike(lambda: 3) == 3
    assert alone.gathered(4) == [4]
    assert torch.arange(5)[alone.share].tolist() == [0, 1, 2, 3, 4]


def test_only_equal_shares_are_shares():
    alone = Alone()
    alone.size = 3
    alone.require_shares("trainer.batch", 9)
    with pytest.raises(InputError, match="trainer.batch is 10, which 3 processes cannot share equally"):
        alone.require_shares("trainer.batch", 10)


def parted(count, play):
    """What ``play(ranks, rank)`` returns, or the kind of what it raises, in each of ``count`` processes."""
    store, children = dist.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False), list[int]()
    for rank in range(count):
        if (child := os.fork()) == 0:
            own = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": count, "MASTER_PORT": store.port}
            os.environ.update({name: str(value) for name, value in own.items()})
            os.environ.update(MASTER_ADDR="127.0.0.1", TORCHELASTIC_RUN_ID="tests", TORCHELASTIC_USE_AGENT_STORE="True")
            joined.cache_clear()
            ranks = joined()
            try:
                told = str(play(ranks, rank))
            except BaseException as error:
                told = type(error).__name__
            ranks.leave()
            client = dist.TCPStore("127.0.0.1", store.port, is_master=False)
            client.set(f"told/{rank}", told)
            os._exit(0)
        children.append(child)
    for child in children:
        os.waitpid(child, 0)
    return [store.get(f"told/{rank}").decode() if store.check([f"told/{rank}"]) else None for rank in range(count)]


def test_processes_have_the_mean_and_what_any_of_them_said():
    def play(ranks, rank):
        assert ranks.agree([rank == 1, False]) == [False, False]  # nothing has been heard yet
        (mean,) = ranks.mean([torch.tensor([float(rank), float("nan")])])
        return mean[0].item(), ranks.agree([False, False]), ranks.from_first(lambda: rank), ranks.gathered(rank)

    assert parted(3, play) == [str((1.0, [True, False], 0, [0, 1, 2]))] * 3


def step(ranks):
    for _ in range(10**6):
        ranks.mean([torch.zeros(3)])


def test_who_fails_is_told_of_by_the_first_and_the_others_leave():
    def play(ranks, rank):
        ranks.fail("f is wrong.") if rank == 1 else step(ranks)

    assert parted(3, play) == [ProblemError.__name__, "None", Left.__name__]


@pytest.mark.parametrize("dies", [0, pytest.param(2, marks=pytest.mark.nightly)])
def test_a_death_is_known_to_all_at_once(dies):
    def play(ranks, rank):
        os._exit(1) if rank == dies else step(ranks)

    others = [LostError.__name__] * 2 if dies == 0 else [LostError.__name__, Left.__name__]
    assert [told for rank, told in enumerate(parted(3, play)) if rank != dies] == others


def test_what_is_wrong_in_one_process_alone_is_raised_by_the_first():
    def play(ranks, rank):
        return ranks.alike(lambda: rank if rank != 1 else int("one"))

    assert parted(2, play) == [InputError.__name__, Left.__name__]
