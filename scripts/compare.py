"""Runs side by side: python scripts/compare.py outputs/circle_pd outputs/sweeps/... [csv=FILE] [plot=FILE.png]

With against=problem.noise (or any other number of the configuration) the plot shows gaps against that."""

from ocp_torch.cli.commands.compare import main

if __name__ == "__main__":
    main()
