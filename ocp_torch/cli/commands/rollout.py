"""A saved controller in a Gymnasium environment."""

from ocp_torch.cli.command import Command
from ocp_torch.gym.rollout import RolloutJob

main = Command("rollout", RolloutJob, lambda made, folder: made.run())
