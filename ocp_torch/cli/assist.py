"""What a process does that torchrun started beside the first one of a run: it helps, writes nothing, and prints nothing while
there is somebody else to say what is wrong."""

import logging
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn

from ocp_torch.cli.outcome import fail
from ocp_torch.cli.single import Checked
from ocp_torch.errors import InputError
from ocp_torch.maths.ranks import Alone, Left, LostError
from ocp_torch.problems.blame import blamed
from ocp_torch.steppers import NonFiniteError
from ocp_torch.training.stopping import Preempted


def assist(ranks: Alone, check: Callable[[], Checked], work: Callable[..., object]) -> NoReturn:
    """``work`` on what ``check`` made, as often as the first process of ``ranks`` wants it, and the end of this process.

    Its status is 0 also where the run fails, unless nobody else can tell: with another one torchrun would end the first
    process in the middle of its last words.
    """
    logging.getLogger().addHandler(logging.NullHandler())  # without any, Python prints warnings
    try:
        work(ranks.alike(check).made, Path())
    except LostError as error:
        fail(f"{str(error).rstrip('.')}; what it saved last is there to go on from.")
    except (Left, Preempted, NonFiniteError, KeyboardInterrupt):  # of which the first process tells
        pass
    except (Exception, SystemExit) as error:
        told = blamed(error) or (error if isinstance(error, InputError) else None)
        ranks.fail(str(told or f"another process of this run failed: {type(error).__name__}: {error}."))
        if told is None:
            raise
    finally:
        ranks.leave()
    sys.exit(0)
