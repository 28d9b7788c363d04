"""The source of every random number: a tree of seeds, grown from the one seed of a run.

`Branch` lists all branches, one for each purpose. Numbers drawn on different branches are independent, so that drawing more
of one kind changes no other, and no set of states is used twice without that being meant.
"""

import contextlib
import random
from collections.abc import Iterator
from enum import IntEnum, unique

import numpy as np
import torch


@unique
class Branch(IntEnum):
    """What draws from each branch of the tree. A number keeps its meaning for ever, so that old runs can be repeated."""

    TRAINING = 0  # states of training batches; rows of a recording
    EVALUATION = 1  # states at which bounds are evaluated and trajectories start; below, the replicate
    WEIGHTS = 2  # the first weights of a run's networks
    POLICY_EVALUATION = 3  # the fit to a closed loop; below, 0 for weights, 1 for states, 2 for rows of a recording
    EXTERNAL_VALUE = 4  # the V trained for a given controller; below, 0 for weights, 1 for states, 2 for visits
    VALIDATION = 5  # all that the quick evaluations during training draw
    DATASET_SPLIT = 6  # which rows of a recording are held out
    BEST_CONSTANT = 7  # states on which the best constant V is computed
    RECORDING = 8  # states of a recording that is made
    VISITS = 9  # training states that follow the closed loop
    SCAN = 10  # states scanned for narrow features of the data
    MIXTURE_POINTS = 12  # points of a mixture; below, the component
    EPISODES = 13  # starts of Gymnasium episodes
    GLOBAL_GENERATORS = 14  # the process's own generators, for problems that draw from them
    FIGURES = 15  # starts for the figures of the density
    TAILS = 16  # fresh states where few carry a bound; below, the round
    PICTURES = 17  # starts of pictured trajectories
    METRICS = 18  # starts for the practitioner's numbers
    MIXTURE_SIZES = 19  # how many points each component of a mixture gets; below, the replicate
    MIXTURE_FIT = 20  # states on which mixtures are fitted, the same in every run
    DRAWN_STARTS = 21  # which weighted starts are kept; below, how many
    MASS = 22  # states for the mass of a density, the same in every run
    REFERENCE = 23  # states between the nodes of a reference grid, the same in every run
    BROWNIAN = 24  # paths of the noise; below, the rows they are for and how often their steps are halved
    POOL = 28  # states that are scored to see where training states count
    START_MASS = 29  # states for the mass of a start; below, the replicate
    TIGHTENING = 30  # states on which V is trained on for the shifted bound
    WARM_START = 31  # pieces of trajectory of the warm start; below, their starts, those of trials, the noise of these
    RUNNING = 32  # states and paths of the running estimates
    REFINEMENT = 33  # states of Gauss-Newton steps; below, the round and the step
    AUDIT = 1000  # which trajectories are simulated again with finer steps


def derive_seed(seed: int, branch: Branch, *path: int) -> int:
    """A seed for the place ``path`` on ``branch`` below ``seed``: distinct places give independent streams."""
    key = (int(branch), *path)
    return int(np.random.SeedSequence(entropy=seed, spawn_key=key).generate_state(1, np.uint64)[0] >> 1)


def fixed_generator(number: int = 0) -> torch.Generator:
    """A generator that is the same in every run: for probes and designs that must not vary with the run's seed."""
    return torch.Generator().manual_seed(number)


@contextlib.contextmanager
def generators_kept() -> Iterator[None]:
    """A context after which the process's own generators, of PyTorch, NumPy and Python, are as they were before."""
    states = np.random.get_state(), random.getstate()  # noqa: NPY002
    # A GPU that was not used yet has no generator to keep.
    used = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else ()
    try:
        with torch.random.fork_rng(devices=used):
            yield
    finally:
        np.random.set_state(states[0])  # noqa: NPY002
        random.setstate(states[1])
