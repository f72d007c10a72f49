"""Metrics in the formats of Prometheus and OpenMetrics.

`requests` counts, `handler` sees what is to be counted, `collector` turns what is counted into metrics, `endpoint`
hands them to whoever scrapes. Only the last two need ``prometheus-client`` (the extra ``metrics``), loaded when used.

1. Off costs nothing: no handler is wrapped, and nothing is counted that is not counted anyway.
2. What a client can choose never makes more than a fixed number of time series: a request cannot fill the memory.
   Addresses of peers are no labels.
"""

from .endpoint import MetricsEndpoint, MetricsSource, start_metrics
from .handler import MeteredHandler
from .requests import PeerClass, RequestTally

__all__ = ["MeteredHandler", "MetricsEndpoint", "MetricsSource", "PeerClass", "RequestTally", "start_metrics"]
