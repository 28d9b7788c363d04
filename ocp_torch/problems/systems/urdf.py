"""The kinematic chain of a robot's URDF file as plain numbers, read through yourdfpy (an optional extra)."""

from pathlib import Path

import numpy as np

from ocp_torch.errors import InputError
from ocp_torch.files.reading import kind, require_file

TURNING, STIFF = ("revolute", "continuous"), "fixed"
# Text of a description in bytes; meshes lie in files of their own, and are not read.
LARGEST_URDF = 2**24


def read_chain(path: str | Path, tip: str | None) -> list[list[float]]:
    """From the base to the link ``tip``: a row for each turning joint, and one for the tip.

    A row is the transform from the joint before, as the 12 numbers of its upper rows, and the axis of the joint (zeros
    for the tip). Without a ``tip``, the link behind the most turning joints, the farthest of them. Limits of joints are left
    out. Raises `InputError` without yourdfpy, for a file that is no URDF, an unknown tip, and joints that slide on the way.
    """
    path = Path(path)
    if kind(path) is None:
        raise InputError(f"problem.urdf is {str(path)!r}, which is not a file.")
    require_file(path, LARGEST_URDF)
    try:
        from yourdfpy import URDF
    except ImportError:
        raise InputError('problem.urdf needs yourdfpy; install it with pip install -e ".[urdf]".') from None
    try:
        nothing = dict.fromkeys(("build_scene_graph", "load_meshes", "build_collision_scene_graph"), False)
        robot = URDF.load(str(path), load_collision_meshes=False, **nothing).robot
    except Exception as error:  # the parsers beneath raise types of their own
        raise InputError(f"problem.urdf = {path} cannot be read as a URDF ({type(error).__name__}).") from None
    above = {joint.child: joint for joint in robot.joints}
    chains = {link.name: _upwards(link.name, above) for link in robot.links}
    usable = {name: chain for name, chain in chains.items() if all(j.type in (*TURNING, STIFF) for j in chain)}
    count = lambda chain: sum(joint.type in TURNING for joint in chain)
    if tip is None:
        tip = max(usable, key=lambda name: (count(usable[name]), len(usable[name])), default=None)
    if tip not in chains:
        raise InputError(f"problem.tip is {tip!r}, but the links of {path} are {', '.join(list(chains)[:40])}.")
    if tip not in usable:
        raise InputError(f"problem.tip is {tip!r}, but a joint on the way there does not turn; take a link before it.")
    if count(usable[tip]) == 0:
        raise InputError(f"problem.tip is {tip!r}, but no joint on the way there turns.")
    return _rows(usable[tip])


def _upwards(link: str, above: dict) -> list:
    """The joints from the base to ``link``."""
    chain, seen = [], set()
    while link in above and link not in seen:
        seen.add(link)
        chain.append(above[link])
        link = above[link].parent
    return chain[::-1]


def _rows(chain: list) -> list[list[float]]:
    rows, transform = [], np.eye(4)
    for joint in chain:
        transform = transform @ (np.eye(4) if joint.origin is None else np.asarray(joint.origin, dtype=float))
        if joint.type in TURNING:
            axis = np.asarray([1.0, 0.0, 0.0] if joint.axis is None else joint.axis, dtype=float)
            rows.append([*transform[:3].flatten().tolist(), *(axis / np.linalg.norm(axis)).tolist()])
            transform = np.eye(4)
    return [*rows, [*transform[:3].flatten().tolist(), 0.0, 0.0, 0.0]]
