"""What the benchmark of reinforcement learning needs beside this package."""

from __future__ import annotations

from ocp_torch.errors import InputError


def require_rl() -> tuple:
    """The modules `gymnasium` and `stable_baselines3`, or an `InputError` that says how to get them."""
    try:
        import gymnasium
        import stable_baselines3
    except ImportError as error:
        raise InputError(
            f'SAC and PPO need packages that are not installed ({error.name}); get them with pip install -e ".[rl]".'
        ) from None
    return gymnasium, stable_baselines3
