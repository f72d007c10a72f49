"""Observation of links and listeners: traces as log lines, capture files, a dissector of frames, and metrics.

==================  ==================================================================================================
`capture`           Capture files for Wireshark, with the bytes of connections and the frames of lines
`capture_files`     Reads capture files: their packets, and the Modbus frames in these
`capture_headers`   Builds the headers around Modbus bytes in capture files
`connection_trace`  The trace of one connection, of the kind that fits its framing
`dissect`           Explains a frame from an unknown source: framing, direction and every field, also of broken frames
`http`              HTTP service for the status and metrics of a program, in threads beside the program's event loop
`http_connection`   One connection of the HTTP service: reads its request, and sends the response
`http_messages`     Request and response of the HTTP service, and the error that it answers by a status
`line_trace`        Trace of RTU and ASCII traffic: log lines, and packets in a capture file
`mbap_trace`        Trace of MBAP traffic (TCP, TLS, UDP): log lines, and bytes in a capture file
`metrics`           Metrics of servers, gateways and links in the formats of Prometheus and OpenMetrics
`pairing`           Pairs the frames heard on a serial line: which reply answers which request, which is missing
`pcapng`            Writes capture files in the pcapng format, which Wireshark and tshark read
`sniffing`          Sniffing: passive listening to a serial line, which is opened to receive and never to send
`socket_addresses`  Local and remote address of a connection, for packets of a capture file
`trace`             The switch of the trace: three levels that can be changed at run time, and a capture file
`wording`           Describes a PDU in one line of words, for lists of frames
==================  ==================================================================================================

Where it is decided: which reply answers which request, and how long one is waited for (``reply_window``): `pairing`. In
which framing a frame from an unknown source is: `dissect`. What is logged at which level: `mbap_trace` on TCP, TLS and
UDP, `line_trace` for RTU and ASCII; which level holds now: `trace`. What is written to a capture file: `capture`; how
one is read: `capture_files`. Which metrics there are: `metrics`.
"""
