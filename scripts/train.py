"""Train a controller and its certificate: python scripts/train.py problem=circle method=pd (--help for all fields)."""

import signal

signal.signal(signal.SIGINT, signal.SIG_DFL)  # Ctrl-C during the slow imports ends quietly

from ocp_torch.cli.commands.train import main  # noqa: E402

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    main()
