"""Certify a finished run again: python scripts/evaluate.py run=outputs/circle_pd/2026-01-01_12-00-00-000000"""

from ocp_torch.cli.commands.evaluate import main

if __name__ == "__main__":
    main()
