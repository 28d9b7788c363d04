"""What a stranger's file may cost: a reader in a process of its own, with its memory and its time measured."""

from __future__ import annotations

import os
import pickle
import resource
import signal
import time
from collections.abc import Callable

from ocp_torch.errors import InputError

# Beyond what the process had before; with the 300 MB that the imports take, below 1 GB.
MEGABYTES, SECONDS = 600, 20.0
# Address space on top of the process's own, so that a failing test cannot take the machine with it.
ROOM = 8 * 2**30


def guarded(function: Callable[[], object], seconds: float = SECONDS, megabytes: float = MEGABYTES) -> str | None:
    """The sentence with which ``function`` is refused, `None` where it is not; fails on any other exception, on more than
    so many megabytes, and on more than so many seconds."""
    read, write = os.pipe()
    started, process = time.monotonic(), os.fork()
    if process == 0:
        try:
            os.close(read)
            os.write(write, pickle.dumps(_measured(function)))
        finally:
            os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as answer:
        signal.signal(signal.SIGALRM, lambda *_: os.kill(process, signal.SIGKILL))
        signal.setitimer(signal.ITIMER_REAL, 3 * seconds)
        content = answer.read()
        signal.setitimer(signal.ITIMER_REAL, 0.0)
    os.waitpid(process, 0)
    took = time.monotonic() - started
    assert content, f"the reader was killed, or did not end, after {took:.0f} s"
    sentence, other, grown = pickle.loads(content)
    assert other is None, other
    assert grown <= megabytes, f"{grown:.0f} MB; {sentence}"
    assert took <= seconds, f"{took:.1f} s; {sentence}"
    return sentence


def refusal(function: Callable[[], object], **limits: float) -> str:
    """The one sentence of a refusal."""
    sentence = guarded(function, **limits)
    assert sentence, "it was not refused"
    assert sentence.isprintable(), sentence
    assert len(sentence) < 2500
    return sentence


def _measured(function: Callable[[], object]) -> tuple[str | None, str | None, float]:
    pages = int(open("/proc/self/statm").read().split()[0])
    room = pages * os.sysconf("SC_PAGE_SIZE") + ROOM
    resource.setrlimit(resource.RLIMIT_AS, (room, room))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    sentence = other = None
    try:
        function()
    except InputError as error:
        sentence = str(error)
    except BaseException as error:
        other = f"{type(error).__name__}: {str(error)[:500]}"
    return sentence, other, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024.0
