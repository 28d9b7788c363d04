"""The processes that torchrun starts for one run: which of them this one is, and what they tell one another.

The first writes, prints and decides; the others take their shares of each batch, and of what the first has to do while they
wait for it. Collectives are for the main thread alone: two threads would begin theirs in another order on every process.
Without torchrun a process is `SingleProcess`, at no cost.
"""

import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import timedelta
from functools import cache
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from ocp_torch.compute.packing import packed, unpacked
from ocp_torch.errors import InputError, ProblemError

T = TypeVar("T")
S = TypeVar("S")

STEP_TIMEOUT = timedelta(minutes=15)  # for the other processes in a step
FIRST_TIMEOUT = timedelta(days=7)  # for the first process, which may be making a certificate
FAREWELL_TIMEOUT = timedelta(seconds=3)  # of a process that has lost the others, for the first to say that it left
# Keys of the store that torchrun keeps.
LEFT_KEY = "ocp_torch/left"  # the first process needs the others no more
FAILED_KEY = "ocp_torch/failed"  # what failed in another process


class LostError(InputError):
    """Another process of the run ended without a word, or does not answer."""


class FirstProcessLeft(BaseException):
    """The first process needs the others no more. No `Exception`: nothing on the way may swallow it."""


class SingleProcess:
    """A run's only process."""

    first, size, share = True, 1, slice(None)
    busy = 1  # processes of the run that compute on this machine now

    def use(self, device: torch.device, problem: object = None) -> None:
        """Prepare for means of what is on ``device``, in a run of ``problem``, which every process has."""

    def require_shares(self, name: str, count: int) -> None:
        """Raise `InputError` where ``count``, which ``name`` was given as, cannot be shared equally."""
        if count % self.size:
            raise InputError(
                f"{name} is {count}, which {self.size} processes cannot share equally; give a multiple of {self.size}."
            )

    def mean(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """The means over all processes of each of ``tensors``, of one precision and on one device."""
        return list(tensors)

    def agree(self, flags: Sequence[bool]) -> list[bool]:
        """Which of ``flags`` any process has raised before the last `mean`: the same answer in all processes."""
        return list(flags)

    def from_first(self, work: Callable[[], T], told: Callable[[T], Any] = lambda found: found) -> Any:
        """The result of ``work``, which only the first process does; the others get what ``told`` makes of that, and until
        then do what is `spread`."""
        return work()

    def spread(self, work: Callable[[Sequence[T]], list[S]], pieces: Sequence[T]) -> list[S]:
        """The results of the pure function ``work`` for each of ``pieces``, shared with processes that wait for this one."""
        return work(pieces)

    def gathered(self, value: T) -> list[T]:
        """The ``value`` of each process."""
        return [value]

    def alike(self, work: Callable[[], T]) -> T:
        """The result of ``work`` here, once all processes have done it; where it fails in any, the first one raises that
        error, and the others raise `FirstProcessLeft`."""
        return work()

    def fail(self, sentence: str) -> None:
        """Have the first process raise `ProblemError` with ``sentence``."""

    def leave(self) -> None:
        """Part from the other processes for good, and end their waiting."""


class ProcessGroup(SingleProcess):
    """One of several processes. Joining, and each collective, raise `LostError` where others are lost, and `FirstProcessLeft`
    where the first one left."""

    def __init__(self, store: Any, rank: int, size: int) -> None:
        self.first, self.size, self.share = rank == 0, size, slice(rank, None, size)
        self._store, self._said, self._heard = store, list[bool](), list[bool]()
        self._steps: Any = None
        self._problem: object = None
        self._waited_for = False  # all others wait for this one in `from_first`
        self._together(self._join)  # the first may have left again before this one is connected

    def _join(self) -> None:
        store = dist.PrefixStore("ocp_torch", self._store)
        dist.init_process_group("gloo", store=store, rank=self.share.start, world_size=self.size, timeout=FIRST_TIMEOUT)
        self._steps = dist.new_group(backend="gloo", timeout=STEP_TIMEOUT)
        dist.barrier(self._steps)  # who leaves before the others are connected makes Gloo print so

    @property
    def busy(self) -> int:  # type: ignore[override]
        return 1 if self._waited_for else int(os.environ.get("LOCAL_WORLD_SIZE", "1"))

    def use(self, device: torch.device, problem: object = None) -> None:
        """Raises `InputError` where a GPU would be that of two processes."""
        self._problem = problem
        if device.type != "cuda" or dist.get_backend(self._steps) == "nccl":
            return
        if (here := int(os.environ["LOCAL_WORLD_SIZE"])) > (has := torch.cuda.device_count()):
            raise InputError(
                f"torchrun started {here} processes on a machine with {has} GPU(s); start as many, or use cpu."
            )
        self._steps = dist.new_group(backend="nccl", timeout=STEP_TIMEOUT)

    def mean(self, tensors: Sequence[Tensor]) -> list[Tensor]:
        """The means, by one sum of one vector, which also carries the flags."""
        said = tensors[0].new_tensor(self._said, dtype=tensors[0].dtype)
        flat = torch.cat([*(t.detach().flatten() for t in tensors), said])
        self._together(lambda: dist.all_reduce(flat, group=self._steps))
        *parts, heard = flat.split([*(t.numel() for t in tensors), len(said)])
        self._heard = (heard > 0.0).tolist()
        return [(part / self.size).view_as(t) for part, t in zip(parts, tensors, strict=True)]

    def agree(self, flags: Sequence[bool]) -> list[bool]:
        self._said = list(flags)
        return [*self._heard, *[False] * len(flags)][: len(flags)]

    def from_first(self, work: Callable[[], T], told: Callable[[T], Any] = lambda found: found) -> Any:
        while not self.first:
            task, found = self._heard_from_first()
            if task is None:
                return found
            self.gathered(self._attempted(*unpacked(task, self._problem)))
        self._waited_for = True
        try:
            found = work()
        finally:
            self._waited_for = False
        self._heard_from_first(None, told(found))
        return found

    def spread(self, work: Callable[[Sequence[T]], list[S]], pieces: Sequence[T]) -> list[S]:
        """The first process does again the pieces at which another one fails, and then says what is wrong; it does all where
        they cannot be sent."""
        if not self._waited_for or len(pieces) < 2 or threading.current_thread() is not threading.main_thread():
            return work(pieces)
        try:
            task = packed((work, pieces), self._problem)
        except Exception:  # whatever a stranger's object may raise
            return work(pieces)
        self._waited_for = False
        try:
            self._heard_from_first(task)
            shares = self.gathered(self._attempted(work, pieces))
        finally:
            self._waited_for = True
        found: list[Any] = [None] * len(pieces)
        for rank, share in enumerate(shares):
            rows = slice(rank, None, self.size)
            found[rows] = work(pieces[rows]) if share is None else share
        return found

    def _attempted(self, work: Callable[[Sequence[T]], list[S]], pieces: Sequence[T]) -> list[S] | None:
        """What ``work`` makes of this process's share of ``pieces``; `None` where it fails."""
        with suppress(Exception, SystemExit):
            return work(pieces[self.share])
        return None

    def _heard_from_first(self, task: bytes | None = None, found: object = None) -> tuple[bytes | None, Any]:
        """A ``task`` of the first process, or what it has ``found`` in the end, in all of them."""
        heard = [(task, found)]
        self._together(lambda: dist.broadcast_object_list(heard, src=0))
        return heard[0]

    def gathered(self, value: T) -> list[T]:
        values: list[Any] = [None] * self.size
        self._together(lambda: dist.all_gather_object(values, value))
        return values

    def alike(self, work: Callable[[], T]) -> T:
        made, error = list[T](), None
        try:
            made.append(work())
        except (Exception, SystemExit) as raised:  # whatever a stranger's module may raise
            error = raised
        failed = [told for told in self.gathered(None if error is None else str(error)) if told is not None]
        if failed:
            raise (error or InputError(failed[0])) if self.first else FirstProcessLeft()
        return made[0]

    def fail(self, sentence: str) -> None:
        self._store.set(FAILED_KEY, sentence)
        self._close()

    def leave(self) -> None:
        if self.first:
            with suppress(RuntimeError):  # torchrun itself is gone
                self._store.set(LEFT_KEY, "")
        self._close()

    def _together(self, collective: Callable[[], object]) -> None:
        with suppress(RuntimeError, ValueError):
            collective()
            return
        self._close()  # so that those that wait for this one see it as well; no traceback may hold the group
        raise self._lost()

    def _lost(self) -> BaseException:
        """The error that says what became of the other processes, as far as the store tells."""
        try:
            if not self.first:
                self._store.wait([LEFT_KEY], FAREWELL_TIMEOUT)
                return FirstProcessLeft()
            if self._store.check([FAILED_KEY]):
                return ProblemError(self._store.get(FAILED_KEY).decode())
        except RuntimeError:  # it is not so, or torchrun itself is gone
            pass
        return LostError(f"{'another' if self.first else 'the first'} process of this run died.")

    def _close(self) -> None:
        self._steps = None
        if dist.is_initialized():
            dist.destroy_process_group()


@cache
def joined() -> SingleProcess:
    """This process among those that torchrun started with it, each with a GPU of its own where there are enough. Raises as
    `ProcessGroup` does."""
    if "TORCHELASTIC_RUN_ID" not in os.environ or int(os.environ.get("WORLD_SIZE", "1")) < 2:
        return SingleProcess()
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]) % torch.cuda.device_count())
    return ProcessGroup(*next(dist.rendezvous("env://", timeout=timedelta(minutes=5))))


def here() -> SingleProcess:
    """This process as `joined` gave it, else `SingleProcess`: a program that only loads a controller does not join others."""
    return joined() if joined.cache_info().currsize else SingleProcess()
