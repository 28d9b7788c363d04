"""A saved controller in a Gymnasium environment: python scripts/rollout.py run=<run> env=Pendulum-v1 video=out.gif"""

from ocp_torch.cli.commands.rollout import main

if __name__ == "__main__":
    main()
