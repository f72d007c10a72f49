"""Observation of links and listeners: traces as log lines, capture files, a dissector of frames, and metrics.

==================  ==================================================================================================
`capture`           Capture files for Wireshark: the bytes of connections and the frames of lines as packets
`capture_headers`   Builds the headers around Modbus bytes in capture files
`dissect`           Dissects a frame from an unknown source: framing, direction and every field, also of broken frames
`http`              HTTP service for the status and the metrics of a program
`line_trace`        Trace of RTU and ASCII lines: log lines, and packets in a capture file
`pairing`           Pairs the frames heard on a serial line
`pcapng`            Writes capture files in the pcapng format, which Wireshark and tshark read
`sniffing`          Sniffing: passive listening to a serial line, which is opened to receive and never to send
`socket_addresses`  Local and remote address of a connection, for packets of a capture file
`trace`             Trace: traffic as log lines, at three levels that can be switched at run time
`wording`           Describes a PDU in one line of text, for lists of frames
`metrics`           Metrics of servers, gateways and links in the formats of Prometheus and OpenMetrics
==================  ==================================================================================================
"""
