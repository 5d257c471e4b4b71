"""Objects that show themselves: a summary as text or HTML, and figures that `kros.report` draws when asked."""

from html import escape
from importlib import import_module
from typing import Any

from ..core import Record


class Shown:
    """What all results of the short way can do: say in a few lines what they are, and draw themselves."""

    def _summary_rows(self) -> Record:
        """Return the rows of the summary by name; those of None, or of an empty text, are left out."""
        raise NotImplementedError

    @property
    def _texts(self) -> list[tuple[str, str]]:
        rows = ((name, value) for name, value in self._summary_rows().items() if value not in (None, ""))
        return [(name, f"{value:.4g}" if isinstance(value, float) else str(value)) for name, value in rows]

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {', '.join(f'{name} {text}' for name, text in self._texts)}>"

    def summary(self) -> str:
        """Return what it is in a few aligned lines, for `print`; notebooks show the same as a table."""
        width = max(len(name) for name, _ in self._texts)
        return "\n".join([type(self).__name__, *(f"{name:<{width}}  {text}" for name, text in self._texts)])

    def _repr_html_(self) -> str:
        """Return the summary as an HTML table."""
        rows = (f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in self._texts)
        return f"<table><caption>{type(self).__name__}</caption>{''.join(rows)}</table>"

    def plot(self, kind: str | None = None, **options: Any) -> Any:
        """Return a figure.

        Parameters
        ----------
        kind : str, optional
            What is drawn, the first by default. A population: ``"recorded"``, an episode. Models: ``"bode"``, magnitude
            and phase. Identified models also: ``"compare"``, simulated beside recorded states with the fit
            ``100 (1 - |x - x_hat| / |x - mean(x)|)``, percent. Uncertain models: ``"weights"``, the bound of the
            residuals. A design, an observer: ``"estimates"``. A run: ``"figure"``.
        **options
            ``unit`` and ``condition`` of recordings, by default the first held-out episode; ``model`` of identified and
            uncertain models, such as ``"linear"`` (in other conditions than that of synthesis those of EDMD only);
            ``models`` of a design, the identified models behind it; ``name`` of a run's figure.

        Returns
        -------
        matplotlib.figure.Figure
            Not known to pyplot; notebooks show it, `figure.savefig(...)` writes it.

        Raises
        ------
        ConfigError
            For kinds and options that the object does not have.

        Examples
        --------
        >>> import kros
        >>> motors = kros.plants.DcMotorPopulation(n_units=1, n_episodes=1, seconds=1.0).simulate().population
        >>> len(motors.plot().axes)  # position, velocity, current and voltage
        4
        """
        return import_module("kros.report.figures").plot(self, kind, **options)
