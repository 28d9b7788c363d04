"""Empty Matplotlib figures, and figures as files. Matplotlib takes half a second to import: only where something is drawn."""

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
    """A figure of ``width`` by ``height`` inches that needs no screen; ``options`` are those of Matplotlib's `Figure`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), **{"layout": "constrained", "dpi": DPI, **options})
    FigureCanvasAgg(figure)
    return figure


def drawn(figures: dict[str, Figure]) -> dict[str, np.ndarray]:
    """The pixels ``(H, W, 3)`` of each figure, drawn once for files and TensorBoard, as layout takes long."""
    pixels = {}
    for name, figure in figures.items():
        canvas: Any = figure.canvas  # Agg's canvas, which has pixels
        canvas.draw()
        pixels[name] = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return pixels


def save_figure(figure: Figure, file: Path, field: str) -> None:
    """Write ``figure`` in the format of the suffix of ``file``; raises `InputError`, about ``field``, for another suffix than
    `FORMS`."""
    form = file.suffix.lower()[1:]
    if form not in FORMS:
        raise InputError(f"{field} is {str(file)!r}, but must end in .png, .pdf or .svg.")
    write_atomically(file, lambda path: figure.savefig(path, format=form, dpi=DPI))


def save(pictures: dict[str, np.ndarray], folder: Path) -> None:
    """Write each of the ``pictures`` of `drawn` as `<name>.png` in ``folder``."""
    if pictures:
        from matplotlib.image import imsave
    for name, pixels in pictures.items():
        write_atomically(folder / f"{name}.png", partial(imsave, arr=pixels, dpi=DPI, format="png"))
