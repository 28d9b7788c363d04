"""Grid solutions for one to three dimensions, to check everything else against: `solve_reference(problem)`."""

from ocp_torch.studies.reference.reference import Reference, solve_reference

__all__ = ["Reference", "solve_reference"]
