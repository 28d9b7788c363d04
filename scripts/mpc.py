"""Model-predictive control with V at the end of a short horizon: python scripts/mpc.py run=<run> steps=10"""

from ocp_torch.cli.commands.mpc import main

if __name__ == "__main__":
    main()
