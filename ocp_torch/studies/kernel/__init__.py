"""The paper's methods in a reproducing-kernel space, as written there: exact kernel or truncated features, in NumPy."""

from ocp_torch.studies.kernel.expansions import FeatureExpansion, KernelExpansion
from ocp_torch.studies.kernel.iterations import Iteration, mirror_prox, sgd
from ocp_torch.studies.kernel.rules import RULES
from ocp_torch.studies.kernel.steps import step_sizes
from ocp_torch.studies.kernel.stream import Stream

__all__ = ["RULES", "FeatureExpansion", "Iteration", "KernelExpansion", "Stream", "mirror_prox", "sgd", "step_sizes"]
