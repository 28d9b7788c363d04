"""Pictures of controlled systems: a scene for each, still or moving. The only rooms that draw know Matplotlib."""

from ocp_torch.runs.pictures.animation import animate, require_gif
from ocp_torch.runs.pictures.picture import Moving, motion, moving
from ocp_torch.runs.pictures.scenes import scene

__all__ = ["Moving", "animate", "motion", "moving", "require_gif", "scene"]
