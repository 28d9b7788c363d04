"""Certify any controller: python scripts/certify.py problem=circle controller=mine.py:u (--help for all fields)."""

from ocp_torch.cli.commands.certify import main

if __name__ == "__main__":
    main()
