"""Pictures of controlled systems: a scene for each, still or moving. Matplotlib is imported where something is drawn."""

from ocp_torch.runs.pictures.animation import animate, require_gif
from ocp_torch.runs.pictures.picture import Moving, motion, moving, practical_figures
from ocp_torch.runs.pictures.scenes import scene

__all__ = ["Moving", "animate", "motion", "moving", "practical_figures", "require_gif", "scene"]
