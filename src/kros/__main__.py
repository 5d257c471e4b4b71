"""``python -m kros`` is the command `kros`."""

from .cli import app

if __name__ == "__main__":
    app()
