"""Record samples of a problem."""

from ocp_torch.cli.command import Command
from ocp_torch.runs.record import arguments, record

main = Command("record", arguments, lambda asked, folder: record(**asked))
