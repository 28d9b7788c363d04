"""Systems in physical units that tests share."""

import math

import torch

from ocp_torch import Angle, Interval, System


class Swing(System):
    """The package's pendulum as a user would write it: angle upright at 0, in units of ``turn`` to a full turn."""

    def __init__(self, turn=2.0 * math.pi, torque=1.0, torque_noise=0.0, **options):
        unit = {2.0 * math.pi: "rad", 360.0: "deg", 1.0: "turn"}[turn]
        self.radian, self.torque_unit, self.torque_noise = turn / (2.0 * math.pi), torque, torque_noise
        fast = 8.0 * self.radian
        coordinates = [Angle("angle", unit=unit), Interval("velocity", -fast, fast, f"{unit}/s")]
        super().__init__(coordinates, ["torque [N m]"], **{"control_weight": 0.25 * torque**2, **options})

    def cost(self, s):
        angle, velocity = (s / self.radian).unbind(-1)
        return 1.25 * (4.0 * (0.5 * angle).sin().square() + 0.1 * velocity.square())

    def dynamics(self, s):
        angle, velocity = s.unbind(-1)
        a = torch.stack([velocity, 15.0 * self.radian * (angle / self.radian).sin()], dim=-1)
        B = s.new_tensor([[0.0], [3.0 * self.radian * self.torque_unit]]).expand(len(s), 2, 1)
        return a, B

    def disturbance(self, s):
        return None if self.torque_noise == 0.0 else self.torque_noise / self.torque_unit * self.dynamics(s)[1]


class Cart(System):
    """A cart with a pole, and two actuators: everything varies with the state, and two coordinates are intervals."""

    def __init__(self, metre=1.0, newton=1.0, noisy=True, **options):
        self.metre, self.newton, self.noisy_force = metre, newton, noisy
        unit = {1.0: "m", 100.0: "cm", 1e-3: "km"}[metre]
        coordinates = [
            Interval("trolley", -2.0 * metre, 2.0 * metre, unit, margin=0.2),
            Angle("pole"),
            Interval("spin", -4.0, 7.0, "rad/s"),
        ]
        weight = [w * newton**2 for w in (0.5, 2.0)]
        super().__init__(coordinates, ["push [N]", "torque [N m]"], **{"control_weight": weight, **options})

    def cost(self, s):
        place, pole, spin = s.unbind(-1)
        return (place / self.metre).square() + (1.0 - pole.cos()) + 0.1 * spin.square()

    def dynamics(self, s):
        place, pole, spin = s.unbind(-1)
        place = place / self.metre
        a = torch.stack([self.metre * 0.4 * spin * pole.sin(), spin, place * pole.sin() + spin * place], dim=-1)
        first = torch.stack([self.metre * (1.0 + 0.5 * pole.cos()), 0.1 * place, pole.cos()], dim=-1)
        second = torch.stack([self.metre * 0.2 * place, torch.zeros_like(pole), 1.0 + 0.3 * spin.square()], dim=-1)
        return a, self.newton * torch.stack([first, second], dim=-1)

    def disturbance(self, s):
        if not self.noisy_force:
            return None
        return 0.1 / self.newton * self.dynamics(s)[1][..., :1] * (1.0 + 0.3 * s[:, 1:2].sin()).unsqueeze(-1)


class Conveyor(System):
    """`s' = speed + u` on an interval: it leaves at a known time."""

    def __init__(self, speed=1.0, discount=1.5, start=None):
        self.speed = speed
        super().__init__([Interval("place", -1.0, 3.0, "m")], ["push [m/s]"], discount=discount, start=start)

    def cost(self, s):
        return 1.0 + 0.0 * s[:, 0]

    def dynamics(self, s):
        return torch.full_like(s, self.speed), torch.ones_like(s).unsqueeze(-1)
