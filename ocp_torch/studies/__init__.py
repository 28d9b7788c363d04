"""Whole comparisons: grids, the paper's kernels and figures, benchmarks. Imports anything but the command line."""
