"""Metrics of servers, gateways and links in the formats of Prometheus and OpenMetrics.

`request_tally` counts, `observer` sees the requests, `metric_families` turns counts into metrics, `http_endpoint`
serves them to a scraper. Only the last two need ``prometheus-client`` (the extra ``metrics``), loaded when used.

1. Without metrics there is no observer, at no cost: only counters that exist anyway are counted.
2. A client cannot create more than a fixed number of time series, so requests cannot fill the memory.
   Addresses of peers are no labels.

Where it is decided: which requests are counted: `observer`; in which series, and how many there are at most:
`request_tally`. Names and labels of metrics: `metric_families`. In which format a scraper gets them, and what it gets
while the program does not answer: `http_endpoint`.
"""

from .http_endpoint import MetricsEndpoint, MetricsSource, start_metrics
from .observer import MetricsObserver
from .request_tally import PeerClass, RequestTally

__all__ = ["MetricsEndpoint", "MetricsObserver", "MetricsSource", "PeerClass", "RequestTally", "start_metrics"]
