"""Compare methods and models on one problem: python scripts/benchmark.py problem=circle seeds=[0,1,2]"""

from ocp_torch.cli.commands.benchmark import main

if __name__ == "__main__":
    main()
