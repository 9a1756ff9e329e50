"""Metrics as Prometheus reads them: a number, or one for each value of a label."""

from collections.abc import Mapping
from typing import TypeVar

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

_F = TypeVar("_F", GaugeMetricFamily, CounterMetricFamily)
_Value = float | Mapping[str, float]


class MetricFamilies:
    """Makes those whose names begin alike."""

    def __init__(self, prefix: str) -> None:
        """Take with what the names begin."""
        self._prefix = prefix

    def gauge(self, name: str, words: str, value: _Value, label: str = "") -> GaugeMetricFamily:
        """What may rise and fall.

        Args:
            name: of the metric, behind the prefix.
            words: what it is, for people.
            value: the number, or one for each value of the label.
            label: its name.
        """
        labels = [label] if label else []
        return _filled(GaugeMetricFamily(self._prefix + name, words, labels=labels), value)

    def counter(self, name: str, words: str, value: _Value, label: str = "") -> CounterMetricFamily:
        """What only grows; for the arguments see `gauge`."""
        return _filled(
            CounterMetricFamily(self._prefix + name, words, labels=[label] if label else []), value
        )


def _filled(family: _F, value: _Value) -> _F:
    if isinstance(value, Mapping):
        for of, number in value.items():
            family.add_metric([of], number)
    else:
        family.add_metric([], value)
    return family
