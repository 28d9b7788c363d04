"""Shipped systems on one page: python scripts/gallery.py systems=[circle,pendulum] (--help for all fields)."""

from ocp_torch.cli.commands.gallery import main

if __name__ == "__main__":
    main()
