"""Write the figures of the documentation's front page from a finished run, for example that of `make demo`.

python benchmarks/front_page.py runs/demo
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from PIL import Image

from kros.cli import app

IMAGES = Path(__file__).parents[1] / "docs" / "images"
FIGURES = {
    "observers": "observers_in_time",
    "models": "free_run",
    "spread": "forms",
    "weights": "weights",
    "outliers": "outlier_scores",
}
WIDTH = 1000  # pixels
COLOURS = 128


def main() -> None:
    """Draw the figures, reduce them in size, and write them."""
    with tempfile.TemporaryDirectory() as folder:
        app(["figures", sys.argv[1], f"{folder}/figures"], standalone_mode=False)
        for name, figure in FIGURES.items():
            image = Image.open(f"{folder}/figures/{figure}.png").convert("RGB")
            height = round(WIDTH * image.height / image.width)
            reduced = image.resize((WIDTH, height), Image.Resampling.LANCZOS).quantize(COLOURS)
            reduced.save(IMAGES / f"{name}.png", optimize=True)


if __name__ == "__main__":
    main()
