"""Simulations of controllers that a later certificate of the same run needs again."""

from dataclasses import dataclass, field
from hashlib import sha256

from ocp_torch.certificate.settings import CertificateSettings
from ocp_torch.certificate.simulated.performance import Simulated
from ocp_torch.control.policies import BOUNDING, DENSITY, MINIMISED, TRAJECTORIES
from ocp_torch.fields.fields import SUBSOLUTION, TRAJECTORY_VALUE, Fields
from ocp_torch.problems.constants import Constants


@dataclass(frozen=True)
class Memory:
    """The last simulation of each controller and effort, in a run of one problem."""

    _kept: dict[tuple, tuple[bytes, Simulated]] = field(default_factory=dict)

    def keep(
        self,
        found: Simulated,
        name: str,
        fields: Fields,
        settings: CertificateSettings,
        seed: int,
        constants: Constants,
    ) -> None:
        """Keep what was ``found`` of the controller ``name`` that the ``fields`` give."""
        self._kept[_effort(name, settings, seed, constants)] = _weights(name, fields), found

    def recall(
        self, name: str, fields: Fields, settings: CertificateSettings, seed: int, constants: Constants
    ) -> Simulated | None:
        """What was kept of the same controller; `None` where nothing was, or of other weights."""
        weights, found = self._kept.get(_effort(name, settings, seed, constants), (b"", None))
        return found if found is not None and weights == _weights(name, fields) else None


def _effort(name: str, settings: CertificateSettings, seed: int, constants: Constants) -> tuple:
    """All that the simulation of the controller ``name`` depends on, within a run, but weights."""
    s, used = settings, (constants.M, constants.C_V) if name in (DENSITY, MINIMISED) else ()  # by their `mu`
    return name, seed, s.trajectories, s.replicates, s.points, s.tolerance, s.horizon, s.audited, s.doublings, used


def _weights(name: str, fields: Fields) -> bytes:
    """What stands for the networks of the controller ``name`` and of its control variate, all their numbers included."""
    own = {TRAJECTORIES: (TRAJECTORY_VALUE,), BOUNDING: tuple(fields.networks)}
    used = own.get(name, tuple(n for n in fields.networks if n not in (TRAJECTORY_VALUE, SUBSOLUTION)))
    networks = [fields.networks[n] for n in used]
    numbers = (t.numpy().tobytes() for network in networks for t in (*network.parameters(), *network.buffers()))
    return sha256(b"".join(numbers)).digest()
