"""Lazy preparation: how every reader makes its population of recordings, steps and checks, and what identifies one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, fields, replace

from pydantic import ValidationError

from ..core import Array, ByName, ConfigError, DataError, frozen, shortened, united
from .population import Channels, EpisodeKey, Population, Scalings, Unit, columns_in_order, natural_key
from .recording import Recording, Recordings, check_episode, check_even, check_period, check_structure, estimate_period
from .steps import STEPS, Signals, Step

HEAD = 100_000  # samples whose median step is the period


@frozen
class PreparedSource:
    """Read a recording, check its time, apply the steps, check the result."""

    recordings: Recordings
    channels: Channels  # as recorded: states, inputs, truths
    period_s: float  # as recorded, found in the episode `reference`
    reference: EpisodeKey
    steps: tuple[Step, ...] = ()
    gaps: bool = False  # whether samples may be missing; see `with_gaps`

    def __call__(self, key: EpisodeKey) -> Array:
        """Return one prepared episode, shape (n_samples, n_channels)."""
        recording, signals = self.recordings(key), Signals(self.channels, self.period_s)
        if not any(step.makes_even for step in self.steps):
            file = self.recordings.file(self.recordings.places[key])
            check_even(recording, self.period_s, self.reference, "" if file is None else f" in {file}")
        elif not self.gaps:  # a running observer has to see that a sample is missing; training does not
            recording = recording.usable(self.period_s)
        for step in self.steps:
            recording = step.apply(recording, signals.channels, signals.period_s)
            signals = step.describe(signals)
        check_episode(recording.values, key, signals.channels, self.gaps)
        return recording.values

    def restricted(self, keys: Iterable[EpisodeKey]) -> PreparedSource:
        """Return the same for fewer episodes."""
        return replace(self, recordings=self.recordings.restricted(keys))


def assemble(
    recordings: Recordings,
    channels: Channels,
    units: Iterable[Unit] = (),
    sample_period_s: float | None = None,
    metadata: ByName | None = None,
    *,
    steps: Iterable[Step] = (),
    scaling: Scalings | None = None,
) -> Population:
    """Make the population of a reader: natural order, one sampling period, steps declared, names checked."""
    check_structure(channels, list(recordings.places))
    if channels != columns_in_order(channels):
        roles = [(c.name, c.role.value) for c in channels]
        raise DataError(f"Channels should list states before inputs, and truths last, found {roles}; reorder them.")
    episodes = tuple(sorted(recordings.places, key=lambda key: [(natural_key(name), name) for name in astuple(key)]))
    facts = {unit.id: unit for unit in units}
    known = tuple(facts.get(unit, Unit(unit)) for unit in dict.fromkeys(key.unit for key in episodes))
    reference = episodes[0]
    if sample_period_s is None:
        sample_period_s, reference = _first_period(recordings, episodes)
    period = check_period(sample_period_s, "Population")
    source = PreparedSource(recordings, channels, period, reference)
    about = dict(metadata or {}), dict(scaling or {})
    return prepare(Population(channels, period, known, episodes, source, *about), steps)


def _first_period(recordings: Recordings, episodes: Sequence[EpisodeKey]) -> tuple[float, EpisodeKey]:
    """Return the sampling period of the first episode whose beginning can be read, and this episode."""
    for key in episodes:
        with suppress(DataError):
            return estimate_period(recordings(key).cut(0, HEAD)), key
    return estimate_period(recordings(episodes[0])), episodes[0]  # says why not


def with_gaps(population: Population) -> Population:
    """Return recordings as a machine gives them, with samples that are NaN or infinite, for a running observer."""
    return replace(population, source=replace(population.source, gaps=True))


def prepare(population: Population, steps: Iterable[Step]) -> Population:
    """Declare preparation steps; they are applied to each episode when it is read.

    Parameters
    ----------
    population : Population
    steps : iterable of Step
        Applied in order, after those declared before.

    Returns
    -------
    Population
        With the channels and the sampling period that the steps leave.

    Raises
    ------
    ConfigError
        When a step does not fit the channels.
    DataError
        When a step adds a channel that is there already, or the truth of what is no state.

    Examples
    --------
    >>> from kros.data import from_arrays, prepare, steps, Channel, Role
    >>> raw = from_arrays({"a": [[[0.0], [1.0], [4.0], [9.0]]]}, (Channel("x", Role.STATE),), sample_period_s=0.1)
    >>> prepare(raw, [steps.Trim(start=1), steps.Scale(("x",), 2.0)]).read(raw.episodes[0]).ravel().tolist()
    [2.0, 8.0, 18.0]
    """
    added = tuple(steps)
    signals = Signals(population.columns, population.sample_period_s, population.scaling)
    for step in added:
        signals = step.describe(signals)
    check_structure(signals.channels, population.episodes)
    columns, period, scaling = columns_in_order(signals.channels), signals.period_s, signals.scaling
    source = replace(population.source, steps=population.source.steps + added)
    return replace(population, columns=columns, sample_period_s=period, scaling=scaling, source=source)


def parse_steps(tables: Iterable[Step | ByName]) -> tuple[Step, ...]:
    """Return steps from TOML tables such as ``{"step": "trim", "start": 1000}``; steps pass through."""
    return tuple(t if isinstance(t, Step) else _parse_step(t, f"data.prepare[{i}]") for i, t in enumerate(tables))


def _parse_step(table: ByName, where: str) -> Step:
    """Return the step of one table."""
    name = table.get("step") if isinstance(table, Mapping) else None
    if not isinstance(name, str) or name not in STEPS:
        raise ConfigError(f"{where}: step should be one of {list(STEPS)}, found {name!r}; correct it.")
    try:
        return united(STEPS[name], {key: v for key, v in table.items() if key != "step"}, {})
    except ValidationError as error:
        problem, known = error.errors()[0], [f.name for f in fields(STEPS[name])]
        key, actual = ".".join(map(str, problem["loc"][1:])), shortened(repr(problem["input"]))
        text = f"{key}: {problem['msg'].lower()}, found {actual}"
        raise ConfigError(f"{where} (step {name!r}): {text}; the keys are {', '.join(known)}.") from error


@dataclass(frozen=True)
class _Divide(Step):
    """Divide columns by sizes."""

    sizes: tuple[float, ...]

    def apply(self, recording: Recording, channels: Channels, period_s: float) -> Recording:
        """Return the recording in the sizes."""
        return replace(recording, values=recording.values / self.sizes)


def scale_population(population: Population, sizes: Mapping[str, float]) -> Population:
    """Return the population with channels, and their truths, divided by sizes; their units are then unknown."""
    owners = [c.of or c.name for c in population.columns]
    source = population.source
    divided = _Divide(tuple(float(sizes.get(name, 1.0)) for name in owners))
    columns = (replace(c, unit="") if name in sizes else c for c, name in zip(population.columns, owners, strict=True))
    return replace(population, source=replace(source, steps=(*source.steps, divided)), columns=tuple(columns))
