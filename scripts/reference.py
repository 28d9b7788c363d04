"""`OPT` from grids, in one to three dimensions: python scripts/reference.py problem=torus (--help for all fields)."""

from ocp_torch.cli.commands.reference import main

if __name__ == "__main__":
    main()
