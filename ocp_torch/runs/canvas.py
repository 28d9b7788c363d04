"""An empty Matplotlib figure, and figures as files. Matplotlib takes half a second of CPU to import: only to draw."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ocp_torch.errors import InputError
from ocp_torch.files.storage import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure
else:
    Figure = Any


DPI = 120
FORMS = ("png", "pdf", "svg")


def blank_figure(width: float, height: float, **options) -> Figure:
    """A figure of so many inches that needs no screen; ``options`` are those of `matplotlib.figure.Figure`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), **{"layout": "constrained", "dpi": DPI, **options})
    FigureCanvasAgg(figure)
    return figure


def drawn(figures: dict[str, Figure]) -> dict[str, np.ndarray]:
    """The pixels ``(H, W, 3)`` of each, for files and for TensorBoard: a figure takes longer to lay out than to compute."""
    pixels = {}
    for name, figure in figures.items():
        canvas: Any = figure.canvas  # that of Agg, which has its pixels
        canvas.draw()
        pixels[name] = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return pixels


def save_figure(figure: Figure, file: Path, field: str) -> None:
    """Write ``figure`` in the form that the name of ``file`` asks for; raises `InputError`, about ``field``, where that is no
    picture's."""
    form = file.suffix.lower()[1:]
    if form not in FORMS:
        raise InputError(f"{field} is {str(file)!r}, but must end in .png, .pdf or .svg.")
    write_atomically(file, lambda path: figure.savefig(path, format=form, dpi=DPI))


def save(pictures: dict[str, np.ndarray], folder: Path) -> None:
    """Write `<name>.png` of each of the ``pictures``, as `drawn` gives them, in ``folder``."""
    if pictures:
        from matplotlib.image import imsave
    for name, pixels in pictures.items():
        write_atomically(folder / f"{name}.png", partial(imsave, arr=pixels, dpi=DPI, format="png"))
