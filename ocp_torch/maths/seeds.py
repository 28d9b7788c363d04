"""Where every random number comes from: a tree of seeds, grown from the one seed of a run.

`Branch` lists all branches, one for each purpose. Numbers drawn on different branches are independent, so that drawing more
of one kind changes no other, and no set of states is used twice without that being meant.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import torch


class Branch(IntEnum):
    """What draws from each branch of the tree. Numbers are never reused: a run of an older version goes on as it began."""

    TRAINING = 0  # states of training batches; rows of a recording
    EVALUATION = 1  # states at which bounds are evaluated, and starts of simulated trajectories, by replicate
    WEIGHTS = 2  # the first weights of the networks of a run
    POLICY_EVALUATION = 3  # weights and states of the fit to a closed loop
    RECORDED_POLICY_EVALUATION = 3  # rows of a recording for that fit
    GLOBAL_GENERATORS = 4  # the process's own generators, for problems that draw from them
    EXTERNAL_VALUE = 4  # weights, states and visits of the V trained for a given controller
    EPISODES = 4  # starts of Gymnasium episodes
    VALIDATION = 5  # all of the quick certificates during training
    FIGURES = 5  # starts for the density plots
    DATASET_SPLIT = 6  # which rows of a recording are held out
    TAILS = 6  # fresh states where few carry a bound
    BEST_CONSTANT = 7  # states for the best constant V
    PICTURES = 7  # starts of pictured trajectories
    RECORDING = 8  # states of a recording that is made
    METRICS = 8  # starts for the practitioner's numbers
    VISITS = 9  # training states that follow the closed loop
    SCAN = 10  # states scanned for narrow features of the data
    RECOMBINATION = 11  # states on which the last layer of V is chosen anew
    MIXTURES = 12  # sizes and points of the components of a mixture
    AUDIT = 1000  # which trajectories are simulated again with finer steps


def derive_seed(seed: int, branch: Branch, *path: int) -> int:
    """A seed for the place ``path`` on ``branch`` below ``seed``: distinct places give independent streams."""
    key = (int(branch), *path)
    return int(np.random.SeedSequence(entropy=seed, spawn_key=key).generate_state(1, np.uint64)[0] >> 1)


def fixed_generator(number: int = 0) -> torch.Generator:
    """A generator that begins in the same place in every run: for probes and designs that shall not vary with its seed."""
    return torch.Generator().manual_seed(number)
