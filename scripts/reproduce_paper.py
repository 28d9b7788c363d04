"""Every figure and number of the paper's numerical sections: python scripts/reproduce_paper.py"""

from ocp_torch.cli.commands.reproduce_paper import main

if __name__ == "__main__":
    main()
