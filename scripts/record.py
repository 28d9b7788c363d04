"""Record samples of a problem: python scripts/record.py problem=manufactured samples=20000 out=data.npz"""

from ocp_torch.cli.commands.record import main

if __name__ == "__main__":
    main()
