"""The part of a process that torchrun started beside the first one of a run: it helps, writes nothing, and prints nothing as
long as the first process can tell what is wrong."""

import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from ocp_torch.cli.outcome import fail
from ocp_torch.cli.single import Checked
from ocp_torch.compute.processes import FirstProcessLeft, LostError, SingleProcess
from ocp_torch.errors import InputError
from ocp_torch.problems.blame import blamed
from ocp_torch.steppers import NonFiniteError
from ocp_torch.training.stopping import Preempted


def assist(ranks: SingleProcess, check: Callable[[], Checked], work: Callable[..., object]) -> NoReturn:
    """Do this process's share of ``work`` on what ``check`` made, then end the process.

    The exit status is 0 even where the run fails, unless no other process can tell the error: otherwise torchrun would kill
    the first process before it has told it.
    """
    logging.getLogger().addHandler(logging.NullHandler())  # without any, Python prints warnings
    try:
        work(ranks.alike(check).made, Path())
    except LostError as error:
        fail(f"{str(error).rstrip('.')}; what it saved last is there to go on from.")
    except (FirstProcessLeft, Preempted, NonFiniteError, KeyboardInterrupt):  # the first process tells these
        pass
    except (Exception, SystemExit) as error:
        told = blamed(error) or (error if isinstance(error, InputError) else None)
        ranks.fail(str(told or f"another process of this run failed: {type(error).__name__}: {error}."))
        if told is None:
            raise
    finally:
        ranks.leave()
    sys.exit(0)
