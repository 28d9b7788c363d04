"""The paper's methods in a reproducing-kernel space, as written there: exact kernel or truncated features, in NumPy."""

from ocp_torch.studies.kernel.iterations import Iteration, step_sizes

__all__ = ["Iteration", "step_sizes"]
