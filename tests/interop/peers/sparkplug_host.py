"""A host application of pysparkplug: prints what edge nodes say, one JSON object for each message.

    sparkplug_host.py PORT [HOST ID]

With an id it is that primary host: online while it runs. A line ``rebirth`` on standard input asks the edge node
``plant/hall`` for its births, and a line of JSON writes a value to a metric of a device: ``device``, ``metric``,
``type``, ``value``, and where they are wanted ``age`` in seconds, ``retain``, ``bare`` for no data type. The end of
standard input ends the program.
"""

import json
import sys
import threading
import time

import pysparkplug as psp
from pysparkplug._datatype import DataType

said = threading.Lock()


def say(**what):
    with said:
        print(json.dumps(what), flush=True)


def heard(client, message):
    topic, payload = message.topic, message.payload
    metrics = [
        {
            "name": metric.name,
            "type": DataType(metric.datatype).name,
            "value": metric.value,
            "historical": bool(metric.is_historical),
            "time": metric.timestamp,
        }
        for metric in getattr(payload, "metrics", ()) or ()
    ]
    if isinstance(payload, psp.NDeath):
        metrics = [{"name": "bdSeq", "type": "INT64", "value": payload.bd_seq_metric.value, "historical": False}]
    say(kind=topic.message_type.name, device=topic.device_id, seq=getattr(payload, "seq", None), metrics=metrics)


def subscribed(client, wanted):
    """Return when the broker has acknowledged so many subscriptions."""
    acknowledged = threading.Semaphore(0)
    client._client.on_subscribe = lambda *_: acknowledged.release()
    return lambda: [acknowledged.acquire(timeout=10) for _ in range(wanted)]


def state(host, online):
    topic = psp.Topic(message_type=psp.MessageType.STATE, sparkplug_host_id=host)
    payload = psp.State(timestamp=time.time_ns() // 1_000_000, online=online)
    return psp.Message(topic=topic, payload=payload, qos=psp.QoS.AT_LEAST_ONCE, retain=True)


def write(client, node, *, device, metric, type, value, age=0.0, retain=False, bare=False):
    sent = int((time.time() - age) * 1000)
    payload = psp.DCmd(timestamp=sent, metrics=(psp.Metric(sent, metric, psp.DataType[type], value=value),))
    topic = psp.Topic(message_type=psp.MessageType.DCMD, **node, device_id=device)
    message = psp.Message(topic=topic, payload=payload, qos=psp.QoS.AT_LEAST_ONCE, retain=retain)
    client.publish(message, include_dtypes=not bare)


def main():
    client = psp.Client()
    host = sys.argv[2] if len(sys.argv) > 2 else None
    node = {"group_id": "plant", "edge_node_id": "hall"}
    if host is None:
        kinds = ("NBIRTH", "NDATA", "NDEATH", "DBIRTH", "DDATA", "DDEATH")
        wait = subscribed(client, len(kinds))
        for kind in kinds:
            device = {"device_id": "+"} if kind.startswith("D") else {}
            topic = psp.Topic(message_type=psp.MessageType[kind], **node, **device)
            client.subscribe(topic, psp.QoS.AT_LEAST_ONCE, heard)
        client.connect("127.0.0.1", port=int(sys.argv[1]))
        wait()
    else:
        connected = threading.Event()
        client.set_will(state(host, False))
        client.connect("127.0.0.1", port=int(sys.argv[1]), callback=lambda _: connected.set())
        connected.wait(10)
        client.publish(state(host, True))
    say(kind="ready")
    for line in sys.stdin:
        if line.strip() == "rebirth":
            metric = psp.Metric(1, "Node Control/Rebirth", psp.DataType.BOOLEAN, value=True)
            payload = psp.NCmd(timestamp=1, metrics=(metric,))
            topic = psp.Topic(message_type=psp.MessageType.NCMD, **node)
            message = psp.Message(topic=topic, payload=payload, qos=psp.QoS.AT_MOST_ONCE, retain=False)
            client.publish(message, include_dtypes=True)
        elif line.startswith("{"):
            write(client, node, **json.loads(line))
    if host is not None:
        client.publish(state(host, False))
        time.sleep(0.2)  # the library has no way to wait until it has left
    client.disconnect()


main()
