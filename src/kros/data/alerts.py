"""What looks wrong in recordings without making them unusable: said once, and shown with the results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .population import Channel, EpisodeKey
from .recording import CHECK, some, title

Array = npt.NDArray[np.float64]
_FACTORS = {  # between units of measure that are mixed up, and what they are
    180 / np.pi: "degrees and radians",
    30 / np.pi: "revolutions per minute and radians per second",
    2 * np.pi: "revolutions and radians, or Hz and rad/s",
    60.0: "minutes and seconds",
    1000.0: "a unit and its thousandth",
}


@dataclass(frozen=True)
class AlertRule:
    """From when on sizes speak for units of measure that are mixed up."""

    near: float = 1.2  # within which a ratio of sizes is one of the factors between units of measure
    compact: float = 3.0  # by which sizes may differ on either side of it


_RULE = AlertRule()


def period_alerts(period_s: float) -> tuple[str, ...]:
    """Return what speaks against a sampling period: a time in ms or us that is taken for seconds."""
    if CHECK.shortest_s < period_s < CHECK.longest_s:
        return ()
    unusual = f"The sampling period of {period_s:g} s is unusual: check the unit of the column of time (time_scale)"
    return (f"{unusual} and sample_period_s, on which every frequency depends.",)


def size_of(values: Array) -> Array:
    """Return the range of every channel from the 5th to the 95th percentile, shape (n_channels,)."""
    low, high = np.percentile(values[:: max(1, len(values) // 2000)], (5, 95), axis=0)
    return np.asarray(high - low)


def scale_alerts(sizes: Mapping[EpisodeKey, Array], channels: Sequence[Channel]) -> tuple[str, ...]:
    """Return which channels have sizes (`size_of`) a factor apart that lies between units of measure, and where."""
    alerts = []
    for i, channel in enumerate(channels):
        for condition in dict.fromkeys(key.condition for key in sizes):
            episodes = {key: size[i] for key, size in sizes.items() if key.condition == condition and size[i] > 0}
            of_unit = {u: [size for key, size in episodes.items() if key.unit == u] for u in {k.unit for k in episodes}}
            text = _two_scales({unit: float(np.median(of)) for unit, of in of_unit.items()})
            text = text or _two_scales({title(key): float(size) for key, size in episodes.items()})
            alerts += [f"{channel.name!r} ({condition}) is {text}"] if text else []
    return tuple(alerts)


def _two_scales(sizes: Mapping[str, float]) -> str:
    """Return the fewer of two groups of sizes, the factor between them and what it may be, or nothing."""
    names = sorted(sizes, key=lambda name: (sizes[name], name))
    logs = np.log([sizes[name] for name in names])
    if len(names) < 2:
        return ""
    cut = int(np.diff(logs).argmax()) + 1
    gap = float(np.median(logs[cut:]) - np.median(logs[:cut]))
    kinds = [text for factor, text in _FACTORS.items() if abs(gap - np.log(factor)) < np.log(_RULE.near)]
    if not kinds or max(np.ptp(logs[:cut]), np.ptp(logs[cut:])) > np.log(_RULE.compact):
        return ""
    smaller = cut <= len(names) - cut
    fewer = some(names[:cut] if smaller else names[cut:])
    factor = f"{np.exp(gap):.3g} times {'smaller' if smaller else 'larger'}"
    return f"{factor} in {fewer} than in the others: are its units of measure mixed up ({' or '.join(kinds)})?"
