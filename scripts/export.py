"""A saved controller for where there is no PyTorch: python scripts/export.py run=<run> format=c out=controller.c"""

from ocp_torch.cli.commands.export import main

if __name__ == "__main__":
    main()
