"""``python -m kros`` is the command `kros`."""

from .cli import app

app()
