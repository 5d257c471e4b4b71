"""From recordings to an observer: family of channels, readouts, reduction, start and gaps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce
from typing import Any

import numpy as np

from ...core import Array, ConfigError, frozen, gain
from ...core.linalg import spectral_radius
from ...lifting import Lifting
from ...synthesis.result import Injection
from ..filter_bank import FilterBank
from ..observer import Observer
from ..runtime import Runtime
from .channels import FAMILIES, channels_of
from .gaps import with_errors, with_fallback
from .reduction import Filters, reduced
from .regression import Readout, is_less
from .rows import Design, Group, Recordings
from .settings import EstimatorSettings


@frozen
class Identified:
    """An estimator with its readout, and facts for the records."""

    observer: Observer
    readout: Readout
    facts: dict[str, Any]


def identify_estimator(
    name: str,
    lifting: Lifting,
    measured: Sequence[int],
    inputs: Sequence[str],
    recordings: Recordings,
    sample_period_s: float,
    parameters: Mapping[str, float] | None = None,
    settings: EstimatorSettings | None = None,
    poles: Sequence[complex] = (),
) -> Identified:
    """Identify the estimator of a population.

    Parameters
    ----------
    name : str
    lifting : Lifting
        Functions of measured states and of inputs become channels; those of other states are ignored.
    measured : sequence of int
    inputs : sequence of str
    recordings : Recordings
        Training episodes of all units.
    sample_period_s : float
    parameters : mapping of str to float, optional
        Default values of the lifting's parameters.
    settings : EstimatorSettings, optional
    poles : sequence of complex, optional
        Of a model of the machines: those with an imaginary part become filters of the inputs alone, for gaps.

    Returns
    -------
    Identified

    Examples
    --------
    >>> import kros
    >>> from kros.data import EpisodeBatch
    >>> from kros.lifting import Lifting
    >>> from kros.observer import EstimatorSettings, Recordings, identify_estimator
    >>> motors = kros.plants.DcMotorPopulation(n_units=2, n_episodes=2, seconds=1.0, seed=3).simulate().population
    >>> recordings = Recordings.of(list(motors.keys()), lambda key: EpisodeBatch.read(motors, [key]))
    >>> few = EstimatorSettings(rows=2000, sample=1000, delays=8)
    >>> lifting = Lifting(motors.states)
    >>> found = identify_estimator("motor", lifting, (0,), motors.inputs, recordings, 0.001, settings=few)
    >>> found.observer.recorded, sorted(found.facts["left_out_percent"])
    (('position', 'velocity', 'current'), ['current', 'velocity'])
    """
    settings, measured = settings or EstimatorSettings(), tuple(measured)
    n = lifting.n_states
    hidden = [i for i in range(n) if i not in measured] or list(measured)
    require_known(settings.unbounded, [lifting.states[i] for i in measured], inputs)
    readout, blind, family = best_family(lifting, measured, inputs, recordings, settings, hidden, poles)

    def observer_of(filters: Filters, fallback: Filters) -> Observer:
        systems = filters, fallback
        observer = assembled(name, lifting, inputs, readout.design, systems, sample_period_s, parameters or {})
        return replace(observer, runtime=bounded(observer, recordings, settings))

    def fallback_of(one: Readout, order: int | None) -> Filters:
        return reduced(replace(one, coefficients=one.coefficients[:, :n]), order)

    filters, fallback = reduced(readout, settings.order), fallback_of(blind, settings.order)
    observer, orders = observer_of(filters, fallback), (len(filters.A), len(fallback.A))

    def trial(group: Group) -> Observer:
        return observer_of(reduced(readout.without(group), orders[0]), fallback_of(blind.without(group), orders[1]))

    trials = [(trial(group), unseen) for group, unseen in readout.left_out_groups()]
    bank = with_fallback(with_errors(observer, recordings, settings), trials, settings)
    observer, states = replace(observer, bank=bank), lifting.states

    def by_state(values: Array) -> dict[str, float]:
        return dict(zip(states, values.tolist(), strict=True))

    errors = readout.typical
    growth = errors / np.exp(np.log(readout.trained).mean(axis=0) / 2)
    worst = np.sqrt(readout.episode_errors().max(axis=0))
    facts = {
        "channels": family,
        "singular_values": filters.singular_values[: 2 * len(filters.A)].tolist(),
        "left_out_percent": {states[i]: 100 * float(errors[i]) for i in hidden},
        "left_out_to_training": {states[i]: float(growth[i]) for i in hidden},
        "left_out_worst_percent": by_state(100 * worst),
        "settle_samples": settle_samples((filters, fallback), bank.recovery),
    }
    return Identified(observer, readout, facts)


def require_known(unbounded: Mapping[str, Sequence[str]], measured: Sequence[str], inputs: Sequence[str]) -> None:
    """Refuse names of unbounded coordinates that are no measured states, or no inputs behind these."""
    others = [name for together in unbounded.values() for name in together]
    if wrong := [*(set(unbounded) - set(measured)), *(set(others) - set(inputs))]:
        raise ConfigError(
            f"Estimator: unbounded should map measured states {measured} to inputs of {inputs}, not {sorted(wrong)}."
        )


def bounded(observer: Observer, recordings: Recordings, settings: EstimatorSettings) -> Runtime:
    """Return limits of the estimates: ranges of hidden states in training, widened by a share, or those declared."""
    low, high = recordings.ranges
    room, states = settings.room, observer.lifting.states
    lower, upper = (np.full(observer.lifting.n_states, end) for end in (-np.inf, np.inf))
    hidden = [i for i in range(len(recordings.size)) if i not in observer.measured]
    lower[hidden], upper[hidden] = (low - room * (high - low))[hidden], (high + room * (high - low))[hidden]
    settings.require_states(observer.recorded)
    for name, ends in settings.limits.items():
        i, size = states.index(name), observer.lifting.sizes_of([name])[0]
        lower[i], upper[i] = max(lower[i], ends[0] / size), min(upper[i], ends[1] / size)
    return Runtime(0, lower, upper)


def best_family(
    lifting: Lifting,
    measured: tuple[int, ...],
    inputs: Sequence[str],
    recordings: Recordings,
    settings: EstimatorSettings,
    hidden: Sequence[int],
    poles: Sequence[complex] = (),
) -> tuple[Readout, Readout, str]:
    """Return the readout of the family that is better by the margin on left-out units than the simpler ones.

    Beside it stands that of inputs alone. The families before the richest are fitted in one go; the richest is only
    where the one before it is the best of them.
    """
    names, n = [*lifting.states, *inputs], lifting.n_states
    ends = (lifting.sizes_of(names) * recordings.ranges).T.tolist()
    known = [*measured, *range(n, len(names))]
    ranges = {names[i]: (ends[i][0], ends[i][1]) for i in known}

    def design(family: str) -> Design:
        return Design.of(channels_of(lifting, measured, inputs, family, ranges, settings), recordings, settings)

    plain = [design(family) for family in FAMILIES[:-1]]
    without = Design.of(plain[0].channels.without_measurements(), recordings, settings, poles)
    (blind,) = Readout.of([without])
    families = dict(zip(FAMILIES, Readout.of(plain), strict=False))

    def better(family: str, other: str) -> str:
        one, before = (families[name].by_fold(hidden) for name in (other, family))
        return other if is_less(one, before, settings.margin) else family

    family = reduce(better, families)
    if family == FAMILIES[-2]:
        families[FAMILIES[-1]] = Readout.of([design(FAMILIES[-1])])[0]
        family = better(family, FAMILIES[-1])
    return families[family], blind, family


def assembled(
    name: str,
    lifting: Lifting,
    inputs: Sequence[str],
    design: Design,
    systems: tuple[Filters, Filters],
    sample_period_s: float,
    parameters: Mapping[str, float],
) -> Observer:
    """Write filters with their readouts, and those of inputs alone, into the model of an observer."""
    channels, bank = design.channels, design.bank
    without, settings = channels.without_measurements(), design.settings
    fade = settings.start_fade * max([*bank.lags, bank.delays])  # m is below one percent then
    filters, fallback = systems[0].absolute(channels), systems[1].absolute(without)
    n, r, s = lifting.n_states, len(filters.A), len(fallback.A)
    bare = channels.lifting
    own = [*(f"filter_{i + 1}" for i in range(r)), *(f"input_filter_{i + 1}" for i in range(s))]
    own += [f"{state}_{what}" for what in ("after_start", "from_inputs") for state in bare.states]
    widened = replace(bare, states=(*bare.states, *own))
    total, columns = widened.n_states, widened.n_lifted + len(inputs) + len(bare.input_functions)
    places = [c if c < n else c + total - n for c in channels.columns]
    blind = [c + total - n for c in without.columns]
    z, w, f, u = np.split(np.arange(n, total), np.cumsum([r, s, n]))
    x, at = np.arange(n), list(channels.measured)
    model, start = np.zeros((total, columns)), np.zeros((total, columns))
    after = filters.C @ filters.S + filters.D  # as if nothing had moved before: no step at the start
    first = after[n:].copy()
    first[at] = np.eye(len(at), len(channels))
    for rows, states, inputs_of, *system in (
        (x, z, places, filters.C[:n], filters.D[:n], first),
        (f, z, places, filters.C[n:], filters.D[n:], after[n:]),
        (z, z, places, filters.A, filters.B, filters.S),
        (w, w, blind, fallback.A, fallback.B, fallback.S),
        (u, w, blind, fallback.C, fallback.D, fallback.C @ fallback.S + fallback.D),
    ):
        model[rows[:, None], states], model[rows[:, None], inputs_of], start[rows[:, None], inputs_of] = system
    held = [at[i] for i in without.held]
    model[u[held], held] = start[u[held], held] = 1.0
    model = np.vstack([model, np.zeros((len(bare.functions), columns))])
    A, B = model[:, : widened.n_lifted], model[:, widened.n_lifted :]
    low, high = (end[at] for end in design.recordings.ranges)
    gaps = FilterBank(  # training says the rest
        filters=r,
        start=start,
        recovery=np.exp([-5 / fade]),
        doubt=np.zeros((r, r)),
        half=np.ones(n),
        reach=high - low,
        noise=np.ones(len(at)),
        rest=np.full(len(at), np.inf),
        gate=np.full(len(at), np.inf),
        opening=np.zeros(len(at)),
        deviations=np.zeros(len(at)),
        persistence=design.recordings.persistence,
    )
    none = gain(np.zeros((len(A), len(channels.measured))), sample_period_s)
    own_values = {p: v for p, v in parameters.items() if p in widened.parameters}
    return Observer(
        name,
        widened,
        A,
        B,
        channels.measured,
        tuple(inputs),
        none,
        Injection.STATE,
        sample_period_s,
        own_values,
        bank=gaps,
    )


def settle_samples(systems: Sequence[Filters], recovery: Array) -> int:
    """Return the samples after which a disturbance is below one percent: five of the slowest time constants."""
    slowest = max([*(float(spectral_radius(f.A)) for f in systems), *recovery])
    return int(np.ceil(-5 / np.log(slowest))) if slowest > 0 else 1
