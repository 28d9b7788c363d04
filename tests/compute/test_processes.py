"""One process is its own mean; several agree, fail and part as they should, by the files each leaves."""

import os
import threading

import pytest
import torch
import torch.distributed as dist

from ocp_torch.certificate.simulated.performance import Simulation
from ocp_torch.compute.processes import FirstProcessLeft, LostError, SingleProcess, here, joined
from ocp_torch.compute.threads import cores, in_pieces, spread
from ocp_torch.control.policies import ValuePolicy
from ocp_torch.errors import InputError, ProblemError
from ocp_torch.maths.jets import chunked_jet
from ocp_torch.problems import Circle
from support.zoo import rough_network


def test_a_process_alone_gives_back_what_it_is_given():
    alone, tensors = joined(), [torch.ones(2), torch.zeros(())]
    assert type(alone) is SingleProcess
    assert all(mean is given for mean, given in zip(alone.mean(tensors), tensors, strict=True))
    assert alone.agree([True, False]) == [True, False]
    assert alone.from_first(lambda: 3) == alone.alike(lambda: 3) == 3
    assert alone.gathered(4) == [4]
    assert torch.arange(5)[alone.share].tolist() == [0, 1, 2, 3, 4]


def test_whoever_has_not_joined_is_alone_in_a_distributed_program_too(monkeypatch):
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "somebody's own")
    monkeypatch.setenv("WORLD_SIZE", "2")
    joined.cache_clear()
    try:
        assert cores() == len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else cores() >= 1
        assert type(here()) is SingleProcess
        assert not dist.is_initialized()
    finally:
        joined.cache_clear()


def test_only_equal_shares_are_shares():
    alone = SingleProcess()
    alone.size = 3
    alone.require_shares("trainer.batch", 9)
    with pytest.raises(InputError, match="trainer.batch is 10, which 3 processes cannot share equally"):
        alone.require_shares("trainer.batch", 10)


def parted(count, play):
    """What ``play(ranks, rank)`` returns, or the kind of what it raises, in each of ``count`` processes."""
    children, tell = list[int](), list[int]()
    for rank in range(count):
        hear, say = os.pipe()
        if (child := os.fork()) == 0:
            port = int(os.read(hear, 16))
            own = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": count, "MASTER_PORT": port}
            os.environ.update({name: str(value) for name, value in own.items()})
            os.environ.update(MASTER_ADDR="127.0.0.1", TORCHELASTIC_RUN_ID="tests", TORCHELASTIC_USE_AGENT_STORE="True")
            joined.cache_clear()
            ranks = joined()
            try:
                told = str(play(ranks, rank))
            except BaseException as error:
                told = type(error).__name__
            ranks.leave()
            client = dist.TCPStore("127.0.0.1", port, is_master=False)
            client.set(f"told/{rank}", told)
            os._exit(0)
        os.close(hear)
        children.append(child)
        tell.append(say)
    # Only now, as the store's thread may hold a lock of the resolver, which a child would then wait for to the end of time.
    store = dist.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
    for say in tell:
        os.write(say, str(store.port).encode())
        os.close(say)
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

    assert parted(3, play) == [ProblemError.__name__, "None", FirstProcessLeft.__name__]


@pytest.mark.nightly
@pytest.mark.parametrize("dies", [0, pytest.param(2, marks=pytest.mark.nightly)])
def test_a_death_is_known_to_all_at_once(dies):
    def play(ranks, rank):
        os._exit(1) if rank == dies else step(ranks)

    others = [LostError.__name__] * 2 if dies == 0 else [LostError.__name__, FirstProcessLeft.__name__]
    assert [told for rank, told in enumerate(parted(3, play)) if rank != dies] == others


def test_what_is_wrong_in_one_process_alone_is_raised_by_the_first():
    def play(ranks, rank):
        return ranks.alike(lambda: rank if rank != 1 else int("one"))

    assert parted(2, play) == [InputError.__name__, FirstProcessLeft.__name__]


def test_those_that_wait_for_the_first_take_their_share_of_its_pieces():
    def play(ranks, rank):
        def work():
            shared = spread(lambda piece: (piece, os.getpid()), list(range(7)))
            return [piece for piece, _ in shared], len({process for _, process in shared})

        return ranks.from_first(work), ranks.from_first(work, told=lambda found: "told")

    answer = ([*range(7)], 3)
    assert parted(3, play) == [str((answer, answer)), *[str((answer, "told"))] * 2]


def test_pieces_at_which_another_process_fails_fail_in_the_first():
    def broken(piece):
        raise ZeroDivisionError(f"of {piece}")

    def odd(piece):
        return broken(piece) if os.environ["RANK"] == "1" else piece

    def work():
        assert spread(odd, [0, 1, 2, 3]) == [0, 1, 2, 3]  # the others' luck is not the first one's
        lock = threading.Lock()
        assert spread(lambda piece: (piece, lock)[0], [0, 1]) == [0, 1]  # which cannot be sent
        with pytest.raises(ZeroDivisionError, match="of 0"):
            spread(broken, [0, 1, 2, 3])
        return spread(abs, [-1, -2, -3])  # and all go on together

    assert parted(2, lambda ranks, rank: ranks.from_first(work)) == ["[1, 2, 3]"] * 2


def test_nothing_is_spread_by_another_thread_nor_where_nobody_waits():
    def play(ranks, rank):
        ranks.use(torch.device("cpu"))
        own = lambda: set(spread(lambda piece: os.getpid(), [0, 1, 2])) == {os.getpid()}
        found = [own()]

        def work():
            thread = threading.Thread(target=lambda: found.append(own()))
            thread.start()
            thread.join()
            found.append(spread(lambda piece: own(), [0, 1]) == [True, True])  # not what was spread already

        ranks.from_first(work)
        return found

    assert parted(2, play) == ["[True, True, True]", "[True]"]


def test_processes_on_one_machine_do_not_take_each_others_cores(monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(8), raising=False)

    def play(ranks, rank):
        os.environ["LOCAL_WORLD_SIZE"] = "2"
        return cores(), ranks.from_first(cores)

    assert parted(2, play) == [str((4, 8))] * 2


@pytest.mark.nightly
def test_a_simulation_and_slopes_are_the_same_to_the_bit_however_many_processes_share_them():
    problem, value, x = Circle(), rough_network(1, 0).double(), torch.rand(9000, 1).double()
    problem.kept = threading.Lock()  # what cannot be sent stays where it is
    policy = ValuePolicy(problem, value)

    def numbers():
        seen = Simulation(problem, policy, 512, 8, 3, tolerance=0.1, rounded=(policy, None)).run()
        (squares,) = in_pieces(lambda rows: (rows**2,), x, True, long=True)
        slopes = chunked_jet(value, x).gradient
        return seen.perf, [float(part.sum()) for part in (seen.end_states, squares, slopes)]

    def play(ranks, rank):
        ranks.use(torch.device("cpu"), problem)
        return ranks.from_first(numbers)

    assert parted(2, play) == [str(numbers())] * 2
