"""The program of one process of `Workers`, run as a file of its own: it answers its parent's requests, and ends with it.

The package is imported only once the parent is watched, so that even a process that is starting ends with its parent.
"""

import ctypes
import os
import signal
import sys
import threading

# What the C library calls it: `prctl(PR_SET_PDEATHSIG, ...)`.
PR_SET_PDEATHSIG = 1
# Exceptions of a pipe whose other end, the parent's, is closed.
GONE = (EOFError, BrokenPipeError, ConnectionResetError)


def end_with_parent(lifeline: int, parent: int, mortal: bool) -> None:
    """End this process as soon as the other end of the pipe ``lifeline`` closes, whatever it is doing.

    Where the parent's main thread started this one (``mortal``) Linux itself ends it too, also while somebody's compiled
    code lets no other thread run; ``parent`` is whose child it was, in case it died before it could be asked for."""

    def wait_for_the_end() -> None:
        while os.read(lifeline, 1):
            pass
        os._exit(1)

    threading.Thread(target=wait_for_the_end, daemon=True).start()
    if mortal and sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def heed_the_parent_alone() -> None:
    """Leave Ctrl-C and a scheduler's SIGTERM, which reach all processes of a run, to the parent. By handlers: an ignored or
    blocked signal would stay so in the programs that a simulator starts."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT, signal.SIGTERM))


def serve(connection) -> None:
    """Answer ``(states, one by one?)`` with ``(True, answer)`` or ``(False, exception)`` until there is nobody to ask."""
    target, path, folder = connection.recv()
    sys.path[:] = path
    os.chdir(folder)
    from ocp_torch.problems.simulator.target import asked, resolved

    function = None
    while True:
        x, one_by_one = connection.recv()
        try:
            function = function or resolved(target)
            connection.send((True, asked(function, x, one_by_one)))
        except GONE:
            raise
        except Exception as error:  # whatever a stranger's code may raise, or give that cannot be sent
            try:
                connection.send((False, error))
            except (TypeError, ValueError, AttributeError, ImportError) as unsendable:
                connection.send((False, RuntimeError(f"{type(error).__name__}: {error} ({unsendable})")))


if __name__ == "__main__":
    sys.path.pop(0)  # this file's folder, whose modules must not be imported by name
    requests, lifeline, parent, mortal = map(int, sys.argv[1:])
    end_with_parent(lifeline, parent, bool(mortal))
    heed_the_parent_alone()
    from multiprocessing.connection import Connection

    try:
        serve(Connection(requests))
    except GONE:
        pass
