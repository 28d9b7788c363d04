"""What the figures of a run show, and what they leave out."""

import torch

from ocp_torch.certificate import certify_fields
from ocp_torch.certificate.context import Context
from ocp_torch.runs import finish
from ocp_torch.runs.figures import Shown, interval_figure
from support.looks import certificate
from support.small import SMALL, configured
from ocp_torch.runs.build import build_trainer
