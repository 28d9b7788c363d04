"""Studies: reference solutions on grids, the paper's kernels and figures, benchmarks. Imports all but the command line."""
