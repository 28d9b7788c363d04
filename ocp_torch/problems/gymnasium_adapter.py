"""Translation between a problem and other people's Gymnasium environments that it is a model of."""

import numpy as np

from ocp_torch.errors import InputError


class GymnasiumAdapter:
    """Override both methods for the Gymnasium environments a problem is a model of; those of this package need neither."""

    def from_observation(self, env: str, observation: np.ndarray | dict) -> np.ndarray:
        """The state ``(d,)`` that an observation of the environment ``env`` shows. Raises `InputError` for an unknown one."""
        raise self._unknown(env)

    def to_action(self, env: str, control: np.ndarray) -> np.ndarray:
        """The action of ``env`` that applies ``control`` ``(m,)``. Raises `InputError` for an unknown one."""
        raise self._unknown(env)

    def _unknown(self, env: str) -> InputError:
        must = "it must define from_observation and to_action"
        return InputError(f"{type(self).__name__} does not know the environment {env}: {must}.")
