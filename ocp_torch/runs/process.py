"""What is set once in a process, before any work: CPU threads, and memory that is kept instead of given back."""

from __future__ import annotations

import ctypes
import platform

import torch

# Parameters of glibc's mallopt, and the largest values it takes.
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
LARGEST_TRIM, LARGEST_MMAP = 2**31 - 1, 2**25


def use_threads(threads: int) -> None:
    """Use ``threads`` CPU threads, and keep freed memory for the next tensor.

    By default glibc returns large blocks to the system at once, and the page faults of getting them back can cost as much as
    the arithmetic. Elsewhere than on glibc only the threads are set.
    """
    torch.set_num_threads(threads)
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        libc.mallopt(M_MMAP_THRESHOLD, LARGEST_MMAP)
        libc.mallopt(M_TRIM_THRESHOLD, LARGEST_TRIM)
