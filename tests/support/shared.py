"""A run that several processes share, as torchrun would start them, but forks of the tests' own, which start at once."""

from __future__ import annotations

import os
from pathlib import Path

import torch.distributed as dist

from ocp_torch.compute.processes import joined
from support.forked import Command, Ended

STORES: list[dist.Store] = []  # one for each run, kept by the tests as torchrun keeps its own


def shared(count: int, *arguments: str, cwd: Path, before=lambda: None) -> list[Command]:
    """`torchrun --nproc-per-node=<count> scripts/train.py <arguments>` under way, its processes in their order."""
    STORES.append(dist.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False))
    started = list[Command]()
    for rank in range(count):

        def place(rank: int = rank) -> None:
            own = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": count, "MASTER_PORT": STORES[-1].port}
            os.environ.update({name: str(value) for name, value in own.items()})
            os.environ.update(MASTER_ADDR="127.0.0.1", TORCHELASTIC_RUN_ID="tests", TORCHELASTIC_USE_AGENT_STORE="True")
            joined.cache_clear()
            before()

        (cwd / str(rank)).mkdir(exist_ok=True)
        started.append(Command("train", *arguments, cwd=cwd / str(rank), before=place))
    return started


def ended(commands: list[Command]) -> list[Ended]:
    return [command.wait() for command in commands]
