"""What to ask of a picture."""

from pathlib import Path
from tempfile import TemporaryDirectory

from matplotlib.figure import Figure
from PIL import Image

from cnfp_torchrl.visual.figures.canvas import save_png


def is_a_picture(path: Path) -> bool:
    """Tell whether a file is a PNG of some size with more to it than a few flat colors."""
    with Image.open(path) as image:
        colors = image.convert("RGB").getcolors(maxcolors=2**24)
        return image.format == "PNG" and min(image.size) > 100 and len(colors) > 40


def draws(figure: Figure) -> bool:
    """Tell whether a figure comes out as a picture."""
    with TemporaryDirectory() as folder:
        return is_a_picture(save_png(figure, Path(folder) / "figure.png", dpi=60))
